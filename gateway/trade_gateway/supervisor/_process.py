"""The process of a child: started with a pipe to its standard input, watched by a pidfd, ended."""

import contextlib
import os
import secrets
import signal
import subprocess
import sys
from pathlib import Path
from typing import Final

import msgspec

from trade import Settings
from trade.command_output import last_line
from trade.starting import Started
from trade.transport.credentials import user_secret
from trade_gateway._usage import ABSENT
from trade_gateway.config._children import Child
from trade_gateway.process._kill_timer import TimerLease
from trade_gateway.process._program import order
from trade_gateway.supervisor._single_instance import alone

_LONGEST: Final = 300
"""The longest quotation of its last line, in characters."""
_MARK: Final = "SUPERVISED_PROGRAM"
"""A variable that all processes of a program inherit."""
_PAGE: Final = os.sysconf("SC_PAGE_SIZE")


class Process:
    """A child process, ``trade WORDS --json`` or a program, which ends when this process ends for any reason.

    Args:
        child: the child.
        logs: the folder for its standard error, ``NAME.log``; the previous process's is ``NAME.1.log``.
        lock: a file that it locks for its life, if it must be unique.
        term: its first lease; None: it may run as long as this process.

    Raises:
        OSError: the process cannot be started.
    """

    def __init__(self, child: Child, logs: Path, lock: Path | None = None, term: TimerLease | None = None) -> None:
        self._log = logs / f"{child.name}.log"
        self._is_program = child.part.entry.program is not None
        self._output = b""
        self._mark = secrets.token_hex(8)
        self.absent = False
        """Whether it ended since a device of its robot file did not answer."""
        self._pid = 0
        """The process id of a program that was started; `_process` watches it."""
        errors = _fresh(self._log)
        try:
            with alone(lock) as locked:
                self._process = subprocess.Popen(  # noqa: S603 - this very program
                    _command(child, self._log, leased=term is not None),
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.DEVNULL if errors is None else errors,
                    env={**_environment(child, logs), **({_MARK: self._mark} if self._is_program else {})},
                    start_new_session=True,  # Ctrl-C is for this process, which ends them in order
                    pass_fds=locked,
                )
        finally:
            if errors is not None:
                os.close(errors)
        try:
            os.set_blocking(self._input, False)
            if term is not None:
                self.send_lease(term)
            os.set_blocking(self.output, False)
            self.end = os.pidfd_open(self._process.pid)
        except OSError:
            self._process.kill()
            self._forget()
            raise

    @property
    def pid(self) -> int:
        """Its process id; of a program, the program's own."""
        return self._pid or self._process.pid

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
        if not data or self._output.endswith(b"\n"):
            return None, bool(data)
        line, ended, _ = (self._output + data).partition(b"\n")
        self._output = line + ended
        if not ended:
            return None, True
        started = msgspec.json.decode(line, type=Started)
        self._pid = started.pid if self._is_program else 0
        return started, True

    def send_lease(self, term: TimerLease) -> None:
        """Sends a lease; a process that does not read keeps the earlier one."""
        with contextlib.suppress(BlockingIOError, BrokenPipeError):
            os.write(self._input, f"{term.line()}\n".encode())

    def terminate(self) -> None:
        """Sends SIGTERM."""
        self._process.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """Sends SIGKILL; the watchdogs of its devices stop their motion. `close` kills what a program has started."""
        self._process.kill()

    def close(self) -> str:
        """Describes how it ended; to be called when `end` becomes readable."""
        os.close(self.end)
        if self._is_program:  # the ended process is not collected yet, so that its group is no other one
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self._process.pid, signal.SIGKILL)
        code = self._forget()
        self.absent = code == ABSENT and not self._is_program
        if self._is_program and code < 0:  # perhaps it was killed, and has not ended what the program started
            _kill_marked(self._mark)
        words = self._last_words() if code > 0 or self._is_program else ""
        detail = f": {words}" if words else ""
        return f"crashed (signal {-code}{detail})" if code < 0 else f"ended (exit code {code}{detail})"

    def _forget(self) -> int:
        code = self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with contextlib.suppress(BrokenPipeError):
                    pipe.close()
        return code

    def _last_words(self) -> str:
        try:
            return last_line(self._log.read_text(encoding="utf-8", errors="replace"))[:_LONGEST]
        except OSError:
            return ""


def _command(child: Child, log: Path, *, leased: bool) -> list[str]:
    entry, words = child.part.entry, child.part.words
    if entry.program is None:
        return [sys.executable, "-m", "trade_gateway", "--with-stdin", *["--leased"][: int(leased)], *words, "--json"]
    asked = order(child.name, words, child.part.folder, log, entry.log_mb, entry.grace_s)
    return [sys.executable, "-m", "trade_gateway.process._program", asked]


def _environment(child: Child, logs: Path) -> dict[str, str]:
    """Returns its variables; a program that opens a container gets all that the wire protocol lists."""
    known = dict(child.environment)
    if not child.part.entry.announces:
        return known
    known.setdefault("TRADE_STATE_DIR", str(logs.parent.parent))
    known.setdefault("TRADE_IDENTITY", Settings.read(environment=known).identity)
    if not known.get("TRADE_TLS"):
        known.setdefault("TRADE_CREDENTIALS", ":".join(user_secret()))
    return known


def _kill_marked(mark: str) -> None:
    """Kills the processes that have a program's mark, also those of other sessions."""
    wanted = f"{_MARK}={mark}".encode()
    for entry in os.scandir("/proc"):
        if entry.name.isdecimal():
            with contextlib.suppress(OSError):  # it has ended, or is another user's
                if wanted in Path(entry.path, "environ").read_bytes().split(b"\0"):
                    os.kill(int(entry.name), signal.SIGKILL)


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
