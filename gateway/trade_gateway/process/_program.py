"""Runs a program for a supervisor, as a process of its own, and leaves no process of the program behind.

It is the subreaper of the program: what the program starts stays its descendant, also in a new session. It ends all of
them with the program, at SIGTERM, and when its standard input ends. It imports only the standard library.
"""

import contextlib
import ctypes
import json
import math
import os
import resource
import selectors
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from types import FrameType
from typing import Any, Final

_PR_SET_CHILD_SUBREAPER: Final = 36
_KILL_EVERY_S: Final = 0.05
_UNKILLABLE_S: Final = 5.0
"""How long to wait for killed processes, in seconds; one of another user cannot be killed."""
_READ_BYTES: Final = 1 << 16
_NOT_STARTED: Final = 127


def order(name: str, words: Sequence[str], folder: Path, log: Path, log_mb: float, grace_s: float) -> str:
    """Returns the argument of this program.

    Args:
        name: the name in its first line of output, which reports that the program was started.
        words: the program and its arguments.
        folder: its working folder.
        log: the file for its output; the previous one is beside it, with ``.1`` before the suffix.
        log_mb: the most that each of the two files takes, in MB.
        grace_s: the time between SIGTERM and SIGKILL, in seconds.
    """
    most_bytes = int(log_mb * 1e6)
    request = {"name": name, "words": list(words), "folder": str(folder), "log": str(log)}
    return json.dumps({**request, "log_bytes": most_bytes, "grace_s": grace_s})


class Log:
    """A log of limited size. Writing fails silently, since a full disk must not stop a program.

    Args:
        path: the file, which is continued.
        most_bytes: at this size, the file replaces the previous one, and a new one begins.
    """

    def __init__(self, path: Path, most_bytes: int) -> None:
        self._path = path
        self._most_bytes = most_bytes
        self._file = -1
        self._size = 0

    def write(self, data: bytes) -> None:
        """Appends output."""
        with contextlib.suppress(OSError):
            if self._size + len(data) > self._most_bytes and self._file >= 0:
                os.close(self._file)
                self._file = -1
                self._path.replace(self._path.with_suffix(".1.log"))
            if self._file < 0:
                flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC
                self._file = os.open(self._path, flags, 0o600)
                self._size = os.fstat(self._file).st_size
            self._size += os.write(self._file, data)

    def say(self, text: str) -> None:
        """Appends a line of this process."""
        self.write(f"trade: {text}\n".encode())


class _Program:
    """The program with its descendants."""

    def __init__(self, request: dict[str, Any]) -> None:
        self.log = Log(Path(request["log"]), request["log_bytes"])
        self._name, self._grace_s = request["name"], request["grace_s"]
        self._selector = selectors.DefaultSelector()
        self._wake, wake = os.pipe()
        os.set_blocking(self._wake, False)
        os.set_blocking(wake, False)
        signal.set_wakeup_fd(wake, warn_on_full_buffer=False)
        self._stop_requested = self._forced = False
        self._status: int | None = None
        """The program's wait status."""
        self._kill_at = self._give_up_at = math.inf
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGCHLD):
            signal.signal(number, self._signalled)
        self._output, output = os.pipe()
        try:
            self._process = subprocess.Popen(  # noqa: S603 - the file of the supervisor names it
                request["words"], stdin=subprocess.DEVNULL, stdout=output, stderr=output, cwd=request["folder"]
            )
        finally:
            os.close(output)
        os.set_blocking(self._output, False)
        self._selector.register(self._wake, selectors.EVENT_READ, lambda: os.read(self._wake, _READ_BYTES))
        self._selector.register(self._output, selectors.EVENT_READ, self._read)
        self._selector.register(0, selectors.EVENT_READ, self._lifeline)

    def run(self) -> int:
        """Returns the program's wait status once no process of it is left."""
        with contextlib.suppress(OSError):  # the supervisor may have ended
            print(json.dumps({"container": self._name, "epoch": "", "pid": self._process.pid}), flush=True)  # noqa: T201
        while self._any_left():
            wait_s = min(self._kill_at, self._give_up_at) - time.monotonic()
            for key, _ in self._selector.select(None if wait_s == math.inf else max(0.0, wait_s)):
                with contextlib.suppress(BlockingIOError):
                    key.data()
        self._read_rest()
        ended_as_asked = self._stop_requested and not self._forced and self._status == signal.SIGTERM
        return 0 if ended_as_asked or self._status is None else self._status

    def _signalled(self, number: int, _frame: FrameType | None) -> None:
        self._stop_requested = self._stop_requested or number != signal.SIGCHLD

    def _any_left(self) -> bool:
        """Collects ended processes, and does what is due; returns whether to wait for more."""
        try:
            while (found := os.waitpid(-1, os.WNOHANG))[0]:
                if found[0] == self._process.pid:
                    self._status = self._process.returncode = found[1]
        except ChildProcessError:
            return False
        now = time.monotonic()
        if self._kill_at == math.inf and (self._stop_requested or self._status is not None):
            left = _descendants()
            if not self._stop_requested:
                self.log.say("it left processes in the background, which end with it; run it in the foreground")
            _signal(left, signal.SIGTERM)
            _signal(left, signal.SIGCONT)  # a stopped process handles no signal
            self._kill_at = now + self._grace_s
        elif self._kill_at <= now:
            if not self._forced:
                self.log.say(f"not ended {self._grace_s:g} s after SIGTERM, so it is killed")
                self._forced, self._give_up_at = True, now + _UNKILLABLE_S
            _signal(_descendants(), signal.SIGKILL)
            self._kill_at = now + _KILL_EVERY_S
        if self._give_up_at <= now:
            self.log.say(f"these processes could not be killed: {_descendants()}")
            return False
        return True

    def _read(self) -> bool:
        """Writes output to the log; returns whether there may be more."""
        data = os.read(self._output, _READ_BYTES)
        if data:
            self.log.write(data)
        else:
            self._selector.unregister(self._output)
        return bool(data)

    def _read_rest(self) -> None:
        with contextlib.suppress(BlockingIOError, KeyError):
            while self._read():
                pass

    def _lifeline(self) -> None:
        if not os.read(0, _READ_BYTES):
            self._selector.unregister(0)
            self._stop_requested = True


def _descendants() -> list[int]:
    """Returns the processes that descend from this one."""
    children: dict[int, list[int]] = {}
    for entry in os.scandir("/proc"):
        if entry.name.isdecimal():
            with contextlib.suppress(OSError, IndexError):
                parent = Path(entry.path, "stat").read_bytes().rpartition(b")")[2].split()[1]
                children.setdefault(int(parent), []).append(int(entry.name))
    found = list(children.get(os.getpid(), ()))
    for pid in found:
        found += children.get(pid, ())
    return found


def _signal(pids: Sequence[int], number: int) -> None:
    for pid in pids:
        with contextlib.suppress(OSError):  # it has ended, or is another user's
            os.kill(pid, number)


def _end_like(status: int) -> None:
    """Ends this process as the program ended."""
    if os.WIFSIGNALED(status):
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        number = os.WTERMSIG(status)
        with contextlib.suppress(OSError):  # no process can change how it handles SIGKILL
            signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)
    sys.exit(os.waitstatus_to_exitcode(status))


def main() -> None:
    """Runs the program that the argument orders."""
    request = json.loads(sys.argv[1])
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    try:
        program = _Program(request)
    except OSError as wrong:
        Log(Path(request["log"]), request["log_bytes"]).say(
            f"{request['words'][0]} cannot be started: {wrong.strerror}"
        )
        sys.exit(_NOT_STARTED)
    _end_like(program.run())


if __name__ == "__main__":
    main()
