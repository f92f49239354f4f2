"""The judge of a story: pure functions from what was recorded and the bytes on the buses to what was wrong."""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from tests.endurance.explore._records import Held, Moved, Stopped
from trade_hil_sim import Entry, events, motion_writes

_ENDING_S: Final = 3.0
"""How long a motion may take to end after its call: the lease of a client that died, then the way to rest."""


def violations(
    groups: Iterable[str],
    logs: Mapping[str, Sequence[Entry]],
    held: Sequence[Held],
    moved: Sequence[Moved],
    stopped: Sequence[Stopped],
) -> list[str]:
    """What was wrong; the logs are by group."""
    found: list[str] = []
    for group in groups:
        log = logs[group]
        found += two_owners([one for one in held if one.group == group])
        for stop in (one for one in stopped if one.group == group):
            found += _moves_in(log, stop)
        found += _moves_without_call(group, log, [one for one in moved if one.group == group])
    return found


def two_owners(held: Sequence[Held]) -> list[str]:
    """Rule S11: a lock has one owner."""
    ordered = sorted(held, key=lambda one: one.since)
    return [
        f"{later.client} and {earlier.client} held {later.group} at {later.since:.6f}"
        for earlier, later in itertools.combinations(ordered, 2)
        if earlier.client != later.client and later.since < earlier.until
    ]


def _moves_in(log: Sequence[Entry], stop: Stopped) -> list[str]:
    """Rules S08 and S09: after a stop was confirmed, nothing moves before it is resumed."""
    goals = [one for one in motion_writes(log, since=stop.since, until=stop.until) if _is_goal(one)]
    starts = events(log, "motion_started", since=stop.since, until=stop.until)
    return [
        f"{stop.group} got {one.name} of {one.registers or one.detail} at {one.t:.6f}, "
        f"{one.t - stop.since:.3f} s after its {stop.what} was confirmed"
        for one in [*goals, *starts][:1]
    ]


def _moves_without_call(group: str, log: Sequence[Entry], moved: Sequence[Moved]) -> list[str]:
    """What begins to move without a call that moves it, or long after it."""
    starts = events(log, "motion_started")
    asked = [(one.since, one.until + _ENDING_S) for one in moved]
    return [
        f"{group} began to move at {one.t:.6f}, and no call moved it"
        for one in starts
        if not any(since <= one.t <= until for since, until in asked)
    ][:1]


def _is_goal(entry: Entry) -> bool:
    return any("goal" in register for register in entry.registers)
