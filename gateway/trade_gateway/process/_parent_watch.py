"""Ends a command together with its parent process, which holds its standard input open."""

import contextlib
import os
import signal
import sys
import threading
from typing import Final

from trade_gateway.process._kill_timer import KillTimer, TimerLease

_LEAVE_S: Final = 15.0
"""How long an orderly shutdown may take, in seconds; a robot is brought to rest first."""


def end_with_stdin(*, leased: bool = False) -> None:
    """Treats the end of standard input as SIGTERM; a process that does not shut down then is ended.

    Args:
        leased: limit the run to the leases on standard input. Each line is a `TimerLease`; waits for the first.

    Raises:
        ConfigurationError: this system has no timer that ends a process.
    """
    leases = _LeaseLines()
    fence = KillTimer(leases.next()) if leased else None
    threading.Thread(target=_watch, args=(leases, fence), name="trade-lifeline", daemon=True).start()


class _LeaseLines:
    """The leases on standard input."""

    def __init__(self) -> None:
        self._incomplete = b""

    def next(self) -> TimerLease:
        """Returns the latest lease; waits for one if there is none. Raises EOFError."""
        lines: list[bytes] = []
        while not lines:
            data = os.read(sys.stdin.fileno(), 65536)
            if not data:
                raise EOFError
            *lines, self._incomplete = (self._incomplete + data).split(b"\n")
        return TimerLease.read(lines[-1].decode())


def _watch(leases: _LeaseLines, fence: KillTimer | None) -> None:
    with contextlib.suppress(EOFError, OSError):  # standard input has ended
        while True:
            term = leases.next()
            if fence is not None:
                fence.move(term)
    os.kill(os.getpid(), signal.SIGTERM)
    threading.Event().wait(_LEAVE_S)
    os._exit(1)
