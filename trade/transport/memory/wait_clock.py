"""A clock of long waits that a test moves ahead of the computer's."""

import itertools
import math
import threading
import time
from collections.abc import Callable
from typing import Final, NamedTuple

from trade.transport.wait_clock import WaitClock

_SOON_S: Final = 0.5
"""How long what is expected may take, in seconds of the computer's clock."""
_GIVEN_S: Final = 0.2
"""How long threads may be late after a step, in seconds of the computer's clock."""
_LOOK_AGAIN_S: Final = 0.002
_PAST_NS: Final = 1000
"""How far a step goes past the end of a wait: times in seconds are rounded."""


class _Wait(NamedTuple):
    due_ns: float
    changed: threading.Condition


class MovedWaitClock(WaitClock):
    """The computer's clocks plus what a test has added. Waits end when their time comes on this clock.

    While a test moves it, it does not follow the computer's clocks: a busy computer takes nothing from a lease.
    """

    def __init__(self) -> None:
        self._ahead_ns = 0
        self._moving_ns: int | None = None
        """The time, while a test moves it."""
        self._moved_at = -math.inf
        """When a step began, by the computer's monotonic clock, in seconds."""
        self._numbers = itertools.count()
        self._waits: dict[int, _Wait] = {}
        self._expected: set[object] = set()
        """The threads that will wait again, conditions on which one will, and what else was announced."""
        self._looking = threading.Condition()
        self._moving = threading.RLock()

    def now(self) -> float:
        return self.now_ns() / 1e9

    def now_ns(self) -> int:
        moving_ns = self._moving_ns
        return time.monotonic_ns() + self._ahead_ns if moving_ns is None else moving_ns

    def time(self) -> float:
        return time.time() + self.ahead_ns / 1e9

    @property
    def ahead_ns(self) -> int:  # type: ignore[override]
        return self.now_ns() - time.monotonic_ns()

    def wait(self, changed: threading.Condition, timeout_s: float | None, *, again: bool = True) -> bool:
        number, thread = next(self._numbers), threading.get_ident()
        due_ns = math.inf if timeout_s is None else self.now_ns() + timeout_s * 1e9
        with self._looking:
            self._waits[number] = _Wait(due_ns, changed)
            self._expected -= {thread, changed}
            self._looking.notify_all()
        try:
            return changed.wait(timeout_s)
        finally:
            with self._looking:
                del self._waits[number]
                if again:
                    self._expected.add(thread)
                self._looking.notify_all()

    def expect(self, what: object = None) -> None:
        with self._looking:
            self._expected.add(threading.get_ident() if what is None else what)

    def arrived(self, what: object = None) -> None:
        with self._looking:
            self._expected.discard(threading.get_ident() if what is None else what)
            self._looking.notify_all()

    def give_time(self, late: Callable[[], bool]) -> None:
        while time.monotonic() < self._moved_at + _GIVEN_S and late():
            time.sleep(_LOOK_AGAIN_S)

    def advance(self, duration_s: float, moved: Callable[[float], None]) -> None:
        """Moves the time from wait to wait, in order of their ends.

        Args:
            duration_s: by how much, in seconds.
            moved: called after each step with its length in seconds; returns when its consequences are known.
        """
        with self._moving:
            now_ns = self._moving_ns = self.now_ns()
            try:
                self._move(now_ns, now_ns + round(duration_s * 1e9), moved)
            finally:
                self._ahead_ns = self._moving_ns - time.monotonic_ns()
                self._moving_ns = None

    def _move(self, now_ns: int, until_ns: int, moved: Callable[[float], None]) -> None:
        self._let_them_run()
        while (found := self._next(until_ns)) is not None:
            number, ending = found
            now_ns = self._step(now_ns, max(now_ns, math.ceil(ending.due_ns)) + _PAST_NS, moved)
            with ending.changed:
                ending.changed.notify_all()
            self._let_them_run(number)
        self._step(now_ns, max(now_ns, until_ns), moved)

    def _next(self, until_ns: int) -> tuple[int, _Wait] | None:
        with self._looking:
            found = min(self._waits.items(), key=lambda one: one[1].due_ns, default=None)
        return found if found is not None and found[1].due_ns <= until_ns else None

    def _step(self, now_ns: int, to_ns: int, moved: Callable[[float], None]) -> int:
        self._moved_at, self._moving_ns = time.monotonic(), to_ns
        moved((to_ns - now_ns) / 1e9)
        return to_ns

    def _let_them_run(self, ended: int = -1) -> None:
        """Waits until a wait has ended, and all threads that wait again do."""
        with self._looking:
            if not self._looking.wait_for(lambda: ended not in self._waits and not self._expected, _SOON_S):
                self._expected.clear()  # they have ended, or do something that takes long
