"""Time that moves only when it is told to, and what is to happen at its moments."""

import heapq
import itertools
import threading
from collections.abc import Callable

__all__ = ["Clock"]


class Clock:
    """A monotonic clock that stands still until somebody moves it.

    What was put off happens on the thread that moves the time: at its moment, in order of its moment, and what falls on
    one moment in the order it was asked for, urgent things first.
    """

    def __init__(self) -> None:
        self._now_ns = 0
        self._lock = threading.Lock()
        self._moving = threading.RLock()
        self._order = itertools.count()
        self._due: list[tuple[int, bool, int, Callable[[], None]]] = []

    def monotonic_ns(self) -> int:
        """The time now, in nanoseconds; starts at zero."""
        return self._now_ns

    def at(self, when_ns: int, action: Callable[[], None], *, urgent: bool = False) -> None:
        """Do something at a time; what lies in the past happens when time moves next."""
        with self._lock:
            heapq.heappush(self._due, (when_ns, not urgent, next(self._order), action))

    def advance(self, duration_s: float) -> None:
        """Move the time on by so many seconds; everything due on the way happens."""
        with self._moving:
            until_ns = self._now_ns + round(duration_s * 1e9)
            while self._step(until_ns):
                pass
            self._now_ns = until_ns

    def step(self) -> bool:
        """Move the time on to what is due next and do it. Returns whether there was anything."""
        with self._moving:
            return self._step(None)

    def _step(self, until_ns: int | None) -> bool:
        with self._lock:
            if not self._due or (until_ns is not None and self._due[0][0] > until_ns):
                return False
            when_ns, _, _, action = heapq.heappop(self._due)
            self._now_ns = max(self._now_ns, when_ns)
        action()
        return True
