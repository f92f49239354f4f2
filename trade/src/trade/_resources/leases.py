"""When leases of locks end: a thread that waits for the next one."""

import math
import threading
from collections.abc import Callable


class Leases:
    """Looks when the next lease may end, and earlier if it is told of one that ends before.

    Args:
        expire: takes away what is over; returns when the next may end, or infinity.
        clock: in which these moments are, in seconds.
    """

    def __init__(self, expire: Callable[[], float], clock: Callable[[], float]) -> None:
        self._expire = expire
        self._clock = clock
        self._sooner = threading.Event()
        self._next_look = math.inf
        self._thread: threading.Thread | None = None
        self._closed = False

    def look_by(self, until: float) -> None:
        """There is a lease that ends then. Two threads may not say so at once."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="trade-leases", daemon=True)
            self._thread.start()
        if until < self._next_look:
            self._sooner.set()

    def _run(self) -> None:
        while not self._closed:
            self._sooner.clear()
            self._next_look = math.inf  # whoever is told of during the look wakes us
            self._next_look = self._expire()
            left_s = self._next_look - self._clock()
            self._sooner.wait(None if left_s == math.inf else max(0.0, left_s))

    def close(self) -> None:
        """End the thread. Idempotent."""
        self._closed = True
        self._sooner.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(2)
