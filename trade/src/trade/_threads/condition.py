"""Waiting that an interrupt may end at any instant.

A condition of the standard library is left broken if Ctrl-C comes between its letting go of the lock and its wait: the
user then sees a RuntimeError. A bare lock has no such instant.
"""

import contextlib
import threading
import time
from collections.abc import Callable


class InterruptibleCondition:
    """Rung whenever something has changed; wakes everybody who waits for it."""

    def __init__(self) -> None:
        self._gates: set[threading.Lock] = set()

    def notify_all(self) -> None:
        """Have those who wait look again. From any thread, never waits."""
        for gate in list(self._gates):
            with contextlib.suppress(RuntimeError):  # rung already
                gate.release()

    def wait_for(self, ready: Callable[[], bool], timeout_s: float | None) -> bool:
        """Wait until it holds; looks now and after every ring. Returns whether it does."""
        until = None if timeout_s is None else time.monotonic() + timeout_s
        gate = threading.Lock()
        gate.acquire()
        self._gates.add(gate)
        try:
            while not ready():
                left = -1 if until is None else until - time.monotonic()
                if until is not None and left <= 0:
                    return False
                gate.acquire(timeout=left)
            return True
        finally:
            self._gates.discard(gate)
