"""A clock that a test moves, and the actions scheduled on it."""

import heapq
import itertools
import threading
from collections.abc import Callable


class Clock:
    """A monotonic clock that advances only when a test moves it.

    Scheduled actions run on the thread that moves the time, in order of their times. Actions of one time run in the
    order in which they were scheduled, urgent ones first.
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
        """Schedule an action; one in the past runs when the time moves next."""
        with self._lock:
            heapq.heappush(self._due, (when_ns, not urgent, next(self._order), action))

    def advance(self, duration_s: float) -> None:
        """Advance the time by some seconds and run every action that becomes due."""
        with self._moving:
            until_ns = self._now_ns + round(duration_s * 1e9)
            while self._step(until_ns):
                pass
            self._now_ns = until_ns

    def step(self) -> bool:
        """Advance the time to the next action and run it. Returns False if none was scheduled."""
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
