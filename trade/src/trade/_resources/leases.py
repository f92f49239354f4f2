"""The expiry of lock leases: a thread that waits for the next one."""

import math
import threading
from collections.abc import Callable


class Leases:
    """Expires leases when they end.

    Args:
        expire: revokes expired grants; returns when the next one may expire, or infinity.
        clock: the clock of these times, in seconds.
    """

    def __init__(self, expire: Callable[[], float], clock: Callable[[], float]) -> None:
        self._expire = expire
        self._clock = clock
        self._sooner = threading.Event()
        self._next_look = math.inf
        self._thread: threading.Thread | None = None
        self._closed = False

    def look_by(self, until: float) -> None:
        """Notes a lease that ends then. Two threads must not call this at once."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="trade-leases", daemon=True)
            self._thread.start()
        if until < self._next_look:
            self._sooner.set()

    def _run(self) -> None:
        while not self._closed:
            self._sooner.clear()
            self._next_look = math.inf  # a lease noted meanwhile wakes this thread
            self._next_look = self._expire()
            left_s = self._next_look - self._clock()
            self._sooner.wait(None if left_s == math.inf else max(0.0, left_s))

    def close(self) -> None:
        """Ends the thread. Idempotent."""
        self._closed = True
        self._sooner.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(2)
