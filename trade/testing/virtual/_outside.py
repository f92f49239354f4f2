"""Finds what waits outside of virtual time: processes, real sockets, and threads that the clock cannot wake."""

import contextlib
import os
import sys
import threading
from pathlib import Path
from typing import Any, Final, cast

from trade.testing.virtual._scheduler import Scheduler, VirtualTimeError

_PROCESSES: Final = {"subprocess.Popen", "os.fork", "os.forkpty", "os.posix_spawn", "os.system", "os.exec"}
_CONNECT: Final = "socket.connect"
_LOOK_S: Final = 0.5
OUTSIDE_S: Final = 10.0
"""How long a thread may wait outside, in real seconds."""

_running: list[Scheduler] = []
"""The one whose threads are watched, if any; an audit hook stays until the process ends."""


def _audit(event: str, args: tuple[Any, ...]) -> None:
    if not _running or (event not in _PROCESSES and event != _CONNECT) or not _running[0].knows_this_thread():
        return
    if event in _PROCESSES:
        what = _words(args) if event == "subprocess.Popen" else event
        raise VirtualTimeError(f"a process was started ({what}): virtual time has threads of this process only")
    if isinstance(args[1], tuple) and not str(cast("tuple[Any, ...]", args[1])[0]).startswith(
        ("127.", "::1", "localhost")
    ):
        raise VirtualTimeError(f"a real socket was used (to {args[1]}): virtual time reaches no other host")


def _words(args: tuple[Any, ...]) -> str:
    given: Any = args[1] or [args[0]]
    return os.fsdecode(given) if isinstance(given, str | bytes) else " ".join(map(os.fsdecode, given))


class Watch:
    """Refuses processes and real sockets, and ends a test whose thread waits in a call that no clock ends.

    Args:
        scheduler: whose threads.
    """

    _hooked = False

    def __init__(self, scheduler: Scheduler) -> None:
        if not Watch._hooked:
            Watch._hooked = True
            sys.addaudithook(_audit)
        _running[:] = [scheduler]
        self._scheduler, self._outside_s = scheduler, OUTSIDE_S
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._look, name="virtual-time-watch", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End it."""
        _running.clear()
        self._over.set()
        self._thread.join()

    def _look(self) -> None:
        turn, looks = -1, 0
        while not self._over.wait(_LOOK_S):
            now = self._scheduler.switches
            looks = looks + 1 if now == turn and _sleeps(self._scheduler.running_native_id) else 0
            turn = now
            if looks * _LOOK_S >= self._outside_s:
                self._scheduler.give_up(self._outside_s)
                return


def _sleeps(native_id: int) -> bool:
    """Whether the kernel has a thread wait for something; False where it does not say so."""
    with contextlib.suppress(OSError, IndexError):
        return Path(f"/proc/self/task/{native_id}/stat").read_text().rpartition(")")[2].split()[0] == "S"
    return False
