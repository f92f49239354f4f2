"""The process of a child: started with a pipe to its standard input, watched by a pidfd, ended."""

import contextlib
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Final

import msgspec

from trade.starting import Started
from trade_gateway.config._children import Child
from trade_gateway.process._kill_timer import TimerLease
from trade_gateway.supervisor._single_instance import alone

__all__ = ["Process", "rss_mb"]

_LONGEST: Final = 300
"""The longest quotation of its last line, in characters."""
_PAGE: Final = os.sysconf("SC_PAGE_SIZE")


class Process:
    """``trade WORDS --json`` as a child process, which ends when this process ends for any reason.

    Args:
        child: the child.
        logs: the folder for its standard error, ``NAME.log``; the previous process's is ``NAME.1.log``.
        lock: a file that it locks for its life, if it must be unique.
        term: its first lease; None: it may run as long as this process.

    Raises:
        OSError: the process cannot be started.
    """

    def __init__(self, child: Child, logs: Path, lock: Path | None = None, term: TimerLease | None = None) -> None:
        leased = [] if term is None else ["--leased"]
        self._log = logs / f"{child.name}.log"
        self._said = b""
        errors = _fresh(self._log)
        try:
            with alone(lock) as locked:
                self._process = subprocess.Popen(  # noqa: S603 - this very program
                    [sys.executable, "-m", "trade_gateway", "--with-stdin", *leased, *child.part.words, "--json"],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.DEVNULL if errors is None else errors,
                    env=dict(child.environment),
                    start_new_session=True,  # Ctrl-C is for this process, which ends them in order
                    pass_fds=locked,
                )
        finally:
            if errors is not None:
                os.close(errors)
        try:
            os.set_blocking(self._input, False)
            if term is not None:
                self.stay(term)
            os.set_blocking(self.output, False)
            self.end = os.pidfd_open(self._process.pid)
        except OSError:
            self._process.kill()
            self._forget()
            raise

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    @property
    def _input(self) -> int:
        assert self._process.stdin is not None  # noqa: S101 - a pipe
        return self._process.stdin.fileno()

    @property
    def output(self) -> int:
        """A file descriptor that becomes readable with new output, or at its end."""
        assert self._process.stdout is not None  # noqa: S101 - a pipe
        return self._process.stdout.fileno()

    def read(self) -> tuple[Started | None, bool]:
        """Reads the line that the process prints once it is up, or None; and whether more may follow.

        Raises:
            ValueError: the first line is another one.
        """
        try:
            data = os.read(self.output, 65536)
        except BlockingIOError:
            return None, True
        if not data or self._said.endswith(b"\n"):
            return None, bool(data)
        line, ended, _ = (self._said + data).partition(b"\n")
        self._said = line + ended
        if not ended:
            return None, True
        return msgspec.json.decode(line, type=Started), True

    def stay(self, term: TimerLease) -> None:
        """Sends a lease; a process that does not read keeps the earlier one."""
        with contextlib.suppress(BlockingIOError, BrokenPipeError):
            os.write(self._input, f"{term.line()}\n".encode())

    def leave(self) -> None:
        """Sends SIGTERM."""
        self._process.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """Sends SIGKILL; the watchdogs of its devices stop their motion."""
        self._process.kill()

    def close(self) -> str:
        """Describes how it ended; to be called when `end` becomes readable."""
        os.close(self.end)
        code = self._forget()
        if code < 0:
            return f"crashed (signal {-code})"
        words = self._last_words() if code else ""
        return f"ended (exit code {code}{f': {words}' if words else ''})"

    def _forget(self) -> int:
        code = self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with contextlib.suppress(BrokenPipeError):
                    pipe.close()
        return code

    def _last_words(self) -> str:
        try:
            lines = self._log.read_text(encoding="utf-8", errors="replace").splitlines()
        except OSError:
            return ""
        return next((line.strip()[:_LONGEST] for line in reversed(lines) if line.strip()), "")


def rss_mb(pid: int) -> float:
    """Returns the resident memory of a process in MB; 0 without a process."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1]) * _PAGE / 1e6
    except (OSError, IndexError):
        return 0.0


def _fresh(log: Path) -> int | None:
    """Opens an empty log; None if that fails, since a full disk must not stop a child."""
    try:
        log.parent.mkdir(parents=True, exist_ok=True)
        if log.exists():
            log.replace(log.with_suffix(".1.log"))
        return os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o600)
    except OSError:
        return None
