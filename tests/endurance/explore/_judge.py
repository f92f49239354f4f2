"""The judge of a story: pure functions from what was recorded and the bytes on the buses to what was wrong."""

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final

from tests.endurance.explore._records import Held, Moved, Stopped
from tests.endurance.explore._robots import KINDS
from trade_hil_sim import LogEntry, events

_HELD_RAD: Final = 0.031
"""A joint has arrived within 0.03 rad of its goal if something blocks it, and takes the rest once that is gone."""
_REFUSED: Final = frozenset({"LockLost", "LockedByOther", "NotLocked"})


def violations(
    logs: Mapping[str, Sequence[LogEntry]],
    held: Sequence[Held],
    moved: Sequence[Moved],
    stopped: Sequence[Stopped],
    ended: float = math.inf,
) -> list[str]:
    """What was wrong; the logs are by group, and end at a moment."""
    found: list[str] = []
    for group, log in logs.items():
        found += two_owners([one for one in held if one.group == group])
        calls = [one for one in moved if one.group == group]
        for stop in (one for one in stopped if one.group == group):
            found += _moves_in(log, _until_moved_again(stop, calls), ended)
        found += _moves_without_call(group, log, calls, ended)
    return found


def two_owners(held: Sequence[Held]) -> list[str]:
    """Rule S11: a lock has one owner."""
    ordered = sorted(held, key=lambda one: one.since)
    return [
        f"{later.client} and {earlier.client} held {later.group} at {later.since:.6f}"
        for earlier, later in itertools.combinations(ordered, 2)
        if earlier.client != later.client and later.since < earlier.until
    ]


def _until_moved_again(stop: Stopped, calls: Sequence[Moved]) -> Stopped:
    again = [one.since for one in calls if one.since >= stop.freed and one.how not in _REFUSED]
    return stop._replace(until=min([stop.until, *again]))


def _moves_in(log: Sequence[LogEntry], stop: Stopped, ended: float) -> list[str]:
    """Rules S08, S09 and S11: what a stop or the loss of a lock has brought to rest gets no goal, and does not move."""
    rests = stop.since + stop.rests_s
    goals = KINDS[stop.group].goals(log, rests, stop.until)
    still = rests + KINDS[stop.group].settles_s
    late = [since for since, until in _motions(log, ended) if max(since, still) < min(until, stop.until)]
    return [
        *(
            f"{stop.group} got {one.name} of {one.registers or one.hex} at {one.t:.6f}, "
            f"{one.t - stop.since:.3f} s after its {stop.what} was confirmed"
            for one in goals[:1]
        ),
        *(
            f"{stop.group} moved from {since:.6f} on, and its {stop.what} was confirmed at {stop.since:.6f}"
            for since in late[:1]
        ),
    ]


def _moves_without_call(group: str, log: Sequence[LogEntry], moved: Sequence[Moved], ended: float) -> list[str]:
    """Rules S04 to S06: each motion is within the time of calls that move its group, and of what these may leave."""
    asked = list(_joined((one.since, one.until + one.lasts_s + KINDS[group].settles_s) for one in moved))
    for since, until in _motions(log, ended):
        over = max((end for begin, end in asked if begin <= since <= end), default=None)
        if over is None:
            return [f"{group} began to move at {since:.6f}, and no call moved it"]
        if until > over:
            return [f"{group} moved from {since:.6f} to {until:.6f}, longer than until {over:.6f}, as its calls allow"]
    return []


def _joined(spans: Iterable[tuple[float, float]]) -> Iterator[tuple[float, float]]:
    """Spans that do not touch, in order."""
    current: tuple[float, float] | None = None
    for begin, end in sorted(spans):
        if current is not None and begin <= current[1]:
            current = current[0], max(current[1], end)
        else:
            if current is not None:
                yield current
            current = begin, end
    if current is not None:
        yield current


def _motions(log: Sequence[LogEntry], ended: float) -> list[tuple[float, float]]:
    """When a device began to move and when it rested again, by its own shaft."""
    found: list[tuple[float, float]] = []
    began: dict[int | None, LogEntry] = {}
    for one in events(log):
        if one.name == "motion_started":
            began.setdefault(one.device_id, one)
        elif one.name == "at_rest" and (start := began.pop(one.device_id, None)) is not None:
            turned_rad = abs((one.position_rad or 0.0) - (start.position_rad or 0.0))
            found += [(start.t, one.t)] if turned_rad > _HELD_RAD else []
    return sorted([*found, *((start.t, ended) for start in began.values())])
