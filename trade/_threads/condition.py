"""A condition variable that Ctrl-C can interrupt safely.

A condition of the standard library breaks if Ctrl-C arrives after it releases its lock and before it waits: the user
then sees a RuntimeError. A bare lock has no such moment. But CPython does not end the wait for a lock if the interrupt
arrives just before it, or in another thread. So the main thread looks from time to time.
"""

import contextlib
import threading
import time
from collections.abc import Callable
from typing import Final

_INTERRUPT_S: Final = 0.5
"""The longest time until the main thread notices an interrupt that did not end its wait."""


class InterruptibleCondition:
    """Wakes all waiting threads whenever something has changed."""

    def __init__(self) -> None:
        self._gates: set[threading.Lock] = set()

    def notify_all(self) -> None:
        """Makes all waiting threads check again. Callable from any thread; never waits."""
        for gate in list(self._gates):
            with contextlib.suppress(RuntimeError):  # notified already
                gate.release()

    def wait_for(self, ready: Callable[[], bool], timeout_s: float | None) -> bool:
        """Waits until ``ready`` holds, checked now and after every notification. Returns whether it holds."""
        until = None if timeout_s is None else time.monotonic() + timeout_s
        gate = threading.Lock()
        gate.acquire()
        self._gates.add(gate)
        try:
            while not ready():
                left_s = threading.TIMEOUT_MAX if until is None else until - time.monotonic()
                if left_s <= 0:
                    return False
                looks = threading.current_thread() is threading.main_thread()
                gate.acquire(timeout=min(left_s, _INTERRUPT_S if looks else threading.TIMEOUT_MAX))
            return True
        finally:
            self._gates.discard(gate)
