"""What ends a command together with the one that started it: standard input, which that one holds open."""

import contextlib
import os
import signal
import sys
import threading
from typing import Final

from trade_gateway.process._kill_timer import KillTimer, TimerLease

_LEAVE_S: Final = 15.0
"""How long it may take to leave in order; a robot is brought to rest first."""


def end_with_stdin(*, leased: bool = False) -> None:
    """From now on the end of standard input is as SIGTERM is; who does not leave then is ended.

    Args:
        leased: it may stay only so long as standard input says. Each line is a `TimerLease`; the first is waited for.

    Raises:
        ConfigurationError: there is no way to end it then for certain.
    """
    told = _Told()
    fence = KillTimer(told.next()) if leased else None
    threading.Thread(target=_watch, args=(told, fence), name="trade-lifeline", daemon=True).start()


class _Told:
    """What is said on standard input."""

    def __init__(self) -> None:
        self._said = b""

    def next(self) -> TimerLease:
        """The latest that is said by now; waits for one if there is none. Raises EOFError."""
        lines: list[bytes] = []
        while not lines:
            data = os.read(sys.stdin.fileno(), 65536)
            if not data:
                raise EOFError
            *lines, self._said = (self._said + data).split(b"\n")
        return TimerLease.read(lines[-1].decode())


def _watch(told: _Told, fence: KillTimer | None) -> None:
    with contextlib.suppress(EOFError, OSError):  # it is as gone as can be
        while True:
            term = told.next()
            if fence is not None:
                fence.move(term)
    os.kill(os.getpid(), signal.SIGTERM)
    threading.Event().wait(_LEAVE_S)
    os._exit(1)
