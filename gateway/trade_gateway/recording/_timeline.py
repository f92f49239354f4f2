"""The time of a recording: that of the wall clock when it begins, continued by the monotonic clock."""

import time
from collections.abc import Hashable
from typing import Final

_FIRST_NS: Final = 86_400 * 10**9
"""Where a recording begins whose wall clock says less, so that no time in its file is negative."""
_STEP_NS: Final = 20_000_000
"""Greater changes of the wall clock against the monotonic one are steps."""
_FRESH_NS: Final = 1_000_000_000
"""Time after a step in which a time by the clock before it may still arrive."""
_APART_S: Final = 1.0
"""A source whose wall clock differs more from ours is placed by its time of arrival."""
_ASTRAY_S: Final = 60.0
"""A source whose monotonic clock differs more from what it was has begun again."""


class Timeline:
    """Converts the times of sources, so that a step of no wall clock is in a recording. For any thread."""

    def __init__(self) -> None:
        wall_ns, running_ns = time.time_ns(), time.monotonic_ns()
        self._ahead_ns = max(wall_ns, _FIRST_NS) - running_ns
        self._stepped: tuple[int, int, int] = self._step_ns(), self._step_ns(), running_ns
        """The difference of the wall clock to this time now and before its last step, and when it was seen."""
        self._sources: dict[Hashable, float] = {}

    def now_ns(self) -> int:
        """Returns nanoseconds since the epoch."""
        return time.monotonic_ns() + self._ahead_ns

    def now_s(self) -> float:
        """Returns seconds since the epoch."""
        return self.now_ns() / 1e9

    def of(self, wall_s: float) -> float:
        """Converts a time that the wall clock of this host has just given."""
        running_ns, step_ns = time.monotonic_ns(), self._step_ns()
        last_ns, before_ns, at_ns = self._stepped
        if abs(step_ns - last_ns) > _STEP_NS:
            before_ns, at_ns = last_ns, running_ns
            self._stepped = (step_ns, before_ns, at_ns)
        found = [wall_s - step_ns / 1e9]
        if running_ns - at_ns < _FRESH_NS:
            found.append(wall_s - before_ns / 1e9)
        now_s = self.now_s()
        return min(found, key=lambda each: (each > now_s + _STEP_NS / 1e9, abs(now_s - each)))

    def placed(self, source: Hashable, wall_s: float, running_ns: int) -> float:
        """Converts the time of a sample.

        Args:
            source: whose clocks these are.
            wall_s: its wall clock.
            running_ns: its monotonic clock.
        """
        now_s, running_s = self.now_s(), running_ns / 1e9
        ahead_s = self._sources.get(source)
        if ahead_s is None or abs(running_s + ahead_s - now_s) > _ASTRAY_S:
            began_s = self.of(wall_s)
            ahead_s = (began_s if abs(began_s - now_s) < _APART_S else now_s) - running_s
            self._sources[source] = ahead_s
        return running_s + ahead_s

    def _step_ns(self) -> int:
        now_ns = self.now_ns()  # first: an interruption between the two then places samples too early, not too late
        return time.time_ns() - now_ns
