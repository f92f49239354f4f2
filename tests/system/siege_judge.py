"""The judge of the siege: a pure function from what planners noted and what simulators logged to what was wrong."""

import re
from bisect import bisect_right
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, cast

from tests.holds import Owned, Verdict, asks_without_end, by_kind, owned, two_owners

from system.siege_records import Answer, AnyRecord, Fault, Order
from trade_hil_sim import Entry

STOPS_S = 6.0
"""A joint whose planner, driver or network is gone for longer than that rests: three of the transport's leases."""
WATCHED_S = 2.0
"""A joint whose driver is gone for longer than that rests: its servo's watchdog waits for 0.5 s."""
_ANSWERED_S = 3.0
"""So long after its deadline a call may end, beside the time that its process did not have."""
_FAR_COUNTS = 100
"""What a stop may take to come to rest, and more; what goes farther was ordered."""
_FREE = ":free"
"""What holds are named that no lock was asked for: among these the last one wins."""
_GOAL = re.compile(r"goal position (-?\d+)")


class Motion(NamedTuple):
    """One of a joint."""

    t: float
    counts: int
    """Where to."""
    far: int
    """From where it began."""
    rests: float
    """When it came to rest; never: infinity."""


def judge(records: Iterable[AnyRecord], logs: Mapping[str, Iterable[Entry]]) -> Verdict:
    """Look for two owners, and for motions that nobody ordered or that came twice, late, without a lock or had no end.

    Args:
        records: of planners, and the faults.
        logs: by robot, of its simulator.
    """
    known = by_kind(records)
    motions = {f"{robot}.{joint}": of for robot, entries in logs.items() for joint, of in motions_of(entries).items()}
    verdict = Verdict()
    verdict.counts.update({kind.__name__.lower(): len(those) for kind, those in known.items()})
    verdict.counts.update(f"fault {fault.what}" for fault in known[Fault])
    verdict.counts.update(f"answer {answer.how}" for answer in known[Answer])
    verdict.counts["motion"] = sum(len(of) for of in motions.values())
    surely = owned(known)
    killed = {fault.whom for fault in known[Fault] if fault.what == "kill planner"}
    verdict.violations += two_owners(surely) + asks_without_end(known, killed) + _unanswered(known, killed)
    for resource, of in sorted(motions.items()):
        orders = sorted((order for order in known[Order] if order.resource == resource), key=lambda order: order.t)
        verdict.violations += _motions(resource, of, orders, surely[resource], known[Fault])
    return verdict


def motions_of(entries: Iterable[Entry]) -> dict[str, list[Motion]]:
    """By joint, what it did."""
    found: dict[str, list[Motion]] = defaultdict(list)
    for entry in entries:
        if entry.kind != "event" or not entry.joint:
            continue
        of, goal = found[entry.joint], _GOAL.search(entry.detail)
        if entry.name == "motion_started" and goal is not None:
            began = entry.position_counts or 0
            if of and of[-1].rests == float("inf"):  # another goal on the way
                of[-1] = of[-1]._replace(rests=entry.t)
            of.append(Motion(entry.t, int(goal[1]), abs(int(goal[1]) - began), float("inf")))
        elif entry.name in ("at_rest", "torque_off", "rebooted") and of and of[-1].rests == float("inf"):
            of[-1] = of[-1]._replace(rests=entry.t)
    return found


def _unanswered(known: dict[type, list[Any]], killed: set[str]) -> list[str]:
    answered = {answer.number: answer.t for answer in known[Answer]}
    found: list[str] = []
    for order in known[Order]:
        late_s = answered.get(order.number, float("inf")) - order.t - order.deadline_s
        late_s -= _frozen_s(known[Fault], _who(order.number), order.t)
        if late_s > _ANSWERED_S and _who(order.number) not in killed:
            found.append(f"{order.number} ordered at {order.t:.3f}, answered {late_s:.1f} s after its deadline")
    return found


def _frozen_s(faults: Sequence[Fault], who: str, since: float) -> float:
    return sum(
        fault.until - fault.t
        for fault in faults
        if fault.what == "freeze planner" and fault.whom == who and fault.until > since
    )


def _who(number: str) -> str:
    return number.partition(":")[0]


def _motions(
    resource: str, motions: Sequence[Motion], orders: Sequence[Order], owned: Sequence[Owned], faults: Sequence[Fault]
) -> list[str]:
    found: list[str] = []
    done, last = Counter[str](), cast("tuple[Motion, Order] | None", None)
    times = [order.t for order in orders]
    since = [span.since for span in owned]
    for motion in motions:
        at = f"{resource} goes to {motion.counts} at {motion.t:.3f}"
        before = orders[: bisect_right(times, motion.t)]
        order = next((order for order in reversed(before) if order.counts == motion.counts), None)
        if order is None:
            if motion.far > _FAR_COUNTS:
                found.append(f"{at}, {motion.far} counts away: nobody ordered that")
            continue
        if motion.far <= _FAR_COUNTS:  # it may be a stop that happens to end there
            continue
        free = last is not None and last[1].hold.endswith(_FREE) and order.hold.endswith(_FREE)
        if last is not None and last[0].rests == motion.t and last[1].hold != order.hold and not free:
            found.append(f"{at} for {order.hold}, while it moves for {last[1].hold}")
        last = (motion, order)
        done[order.number] += 1
        if done[order.number] > 1:
            found.append(f"{at}: {order.number} is done again")
        if motion.t > order.t + order.deadline_s:
            found.append(f"{at}: {order.number} is done after its deadline of {order.deadline_s:g} s")
        span = owned[bisect_right(since, motion.t) - 1] if since and since[0] <= motion.t else None
        if span is not None and span.hold != order.hold and motion.t < span.until:
            found.append(f"{at} for {order.hold} while {span.hold} had it")
        found += _goes_on(at, motion, order, resource, faults)
    return found


def _goes_on(at: str, motion: Motion, order: Order, resource: str, faults: Sequence[Fault]) -> list[str]:
    """Whether it went on although who ordered it, or who carried it out, was gone for long enough."""
    found: list[str] = []
    for fault in faults:
        most_s = _must_rest_s(fault, order, resource)
        if most_s is None or not motion.t < fault.t < motion.rests:
            continue
        if min(motion.rests, fault.until) - fault.t > most_s:
            found.append(f"{at} and on for {motion.rests - fault.t:.1f} s after {fault.what} {fault.whom}")
    return found


def _must_rest_s(fault: Fault, order: Order, resource: str) -> float | None:
    robot = resource.partition(".")[0]
    match fault.what:
        case "kill planner" | "freeze planner":
            return STOPS_S if fault.whom == _who(order.number) else None
        case "kill gateway" | "freeze gateway" | "cut" | "one way":
            return STOPS_S
        case "kill driver" | "freeze driver" | "unplug":
            return WATCHED_S if fault.whom == robot else None
        case _:
            return None
