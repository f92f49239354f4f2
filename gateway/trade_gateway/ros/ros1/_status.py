"""States of a goal: the constants of actionlib_msgs/GoalStatus."""

import time
from enum import IntEnum
from typing import Final

Time = dict[str, int]


class Status(IntEnum):
    """State of a goal, as its server reports it."""

    PENDING = 0
    ACTIVE = 1
    PREEMPTED = 2
    SUCCEEDED = 3
    ABORTED = 4
    REJECTED = 5
    PREEMPTING = 6
    RECALLING = 7
    RECALLED = 8
    LOST = 9


ENDED: Final = frozenset(
    {Status.PREEMPTED, Status.SUCCEEDED, Status.ABORTED, Status.REJECTED, Status.RECALLED, Status.LOST}
)


def now() -> Time:
    """Returns the current time of day."""
    return _day(time.time_ns())


def day(at: float) -> Time:
    """Converts a time of ``time.monotonic()`` to the time of day."""
    return _day(time.time_ns() - int((time.monotonic() - at) * 1e9))


def _day(nanoseconds: int) -> Time:
    seconds, rest = divmod(nanoseconds, 1_000_000_000)
    return {"sec": seconds, "nanosec": rest}
