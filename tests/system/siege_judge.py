"""The judge of the siege: a pure function from what clients noted and what simulators logged to what was wrong."""

from bisect import bisect_right
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from math import inf
from typing import Any, NamedTuple

from tests.support.lock_log import Owned, Verdict, asks_without_end, by_kind, owned, two_owners
from tests.system.siege_records import CAN_BUS, Alarm, Answer, AnyRecord, Fault, Order, Rescue, whole
from trade_hil_sim import LogEntry

STOPS_S = 6.0
"""A joint whose client, driver or network is gone for longer than that rests: three of the transport's leases."""
WATCHED_S = 2.0
"""A joint whose driver is gone for longer than that rests: its servo's watchdog waits for 0.5 s."""
FULL_SPEED = 100
"""What is written with so much and more (of 0.229 rpm) is a stop: no client orders more than 84."""
_ANSWERED_S = 3.0
"""So long after its deadline a call may end, beside the time that its process did not have."""
_IN_THE_WAY = frozenset(
    ("kill driver", "freeze driver", "unplug", "bus off", "kill gateway", "freeze gateway", "cut", "one way", "disk")
)
"""Troubles in which a stop cannot get through, or cannot be confirmed."""
_BACK_S = 15.0
_FAR_COUNTS = 100
"""What a stop may take to come to rest, and more; what goes farther was ordered."""
_FREE = ":free"
"""What holds are named that no lock was asked for: among these the last one wins."""
_SPEED, _GOAL = 112, 116
"""Addresses of profile velocity and goal position, four bytes each: XL430 e-Manual, control table."""
_GO, _HALT, _QUICK_STOP, _NO_QUICK_STOP = 1 << 4, 1 << 8, 1 << 1, 1 << 2
"""Bits of a drive's controlword: new set-point, halt; a quick stop is the one without the other: CiA 402-2."""
_CENTRE = 2048
"""Where a servo counts from, and a drive does not."""


class Motion(NamedTuple):
    """One of a joint, from a goal that it was given to the next one or to rest."""

    t: float
    counts: int
    """Where to."""
    at: int
    """Where it was then."""
    rests: float = inf
    """When it came to rest or was given another goal; never: infinity."""
    stopped: bool = False
    """Whether it got a stop on its way."""
    turned: bool = False
    """Whether it was given its goal on the way to another one."""

    @property
    def far(self) -> int:
        """How far it has to go."""
        return abs(self.counts - self.at)


def judge(records: Iterable[AnyRecord], logs: Mapping[str, Iterable[LogEntry]]) -> Verdict:
    """Look for two owners, and for motions that no client ordered that came twice, late, without a lock or without end.

    Args:
        records: of clients, and the faults.
        logs: by robot, of its simulator.
    """
    known = by_kind(records)
    motions = {f"{robot}.{joint}": of for robot, entries in logs.items() for joint, of in motions_of(entries).items()}
    verdict = Verdict()
    verdict.counts.update({kind.__name__.lower(): len(those) for kind, those in known.items()})
    verdict.counts.update(f"fault {fault.what}" for fault in known[Fault])
    verdict.counts.update(f"answer {answer.how}" for answer in known[Answer])
    verdict.counts.update(f"order of a {_kind(order.number)}" for order in known[Order])
    verdict.counts["motion"] = sum(len(of) for of in motions.values())
    of_drives = [of for resource, of in motions.items() if f".{CAN_BUS}." in resource]
    verdict.counts["motion of a drive"] = sum(map(len, of_drives))
    verdict.counts["motion turned"] = sum(motion.turned for of in motions.values() for motion in of)
    surely = owned(known)
    killed = {fault.whom for fault in known[Fault] if fault.what == "kill client"}
    verdict.counts.update("rescue got through" for rescue in known[Rescue] if rescue.through)
    verdict.violations += _not_rescued(known) + _not_latched(known, motions)
    verdict.violations += two_owners(surely) + asks_without_end(known, killed) + _unanswered(known, killed)
    for resource, of in sorted(motions.items()):
        orders = sorted((order for order in known[Order] if order.resource == resource), key=lambda order: order.t)
        found, done = _motions(resource, of, orders, surely[resource], known[Fault])
        verdict.violations += found
        verdict.counts["order carried out"] += done
    return verdict


def motions_of(entries: Iterable[LogEntry]) -> dict[str, list[Motion]]:
    """By joint, what it did: it reports starts and rest; on its way, its commands count.

    Who comes to rest after a goal has come and before it reads it sets off for it later: that is the same motion.
    """
    found: dict[str, list[Motion]] = defaultdict(list)
    unread: set[str] = set()
    """Joints that were given a goal on their way, and have not been seen to do anything for it."""
    drives: dict[str, Drive] = defaultdict(Drive)
    for entry in entries:
        of = found[entry.joint]
        if entry.joint.startswith(f"{CAN_BUS}."):
            drives[entry.joint].take(entry, of)
            continue
        going = bool(of) and of[-1].rests == inf
        if entry.kind == "instruction":
            unread.discard(entry.joint)
        match entry.kind, entry.name:
            case "event", "motion_started" if entry.joint in unread:
                unread.discard(entry.joint)
                of[-1] = of[-1]._replace(rests=inf)
            case "event", "motion_started":
                of.append(Motion(entry.t, int(entry.detail.rpartition(" ")[2]), entry.position_counts or 0))
            case "event", "at_rest" | "torque_off" | "rebooted" if going:
                of[-1] = of[-1]._replace(rests=entry.t)
                if entry.name != "at_rest" or _there(of[-1], entry.position_counts or 0):
                    unread.discard(entry.joint)
            case "instruction", _ if going and "goal_position" in entry.registers:
                speed, goal = _written(entry, _SPEED), _written(entry, _GOAL)
                if speed is None or goal is None or speed >= FULL_SPEED:
                    of[-1] = of[-1]._replace(stopped=True)
                else:
                    of[-1] = of[-1]._replace(rests=entry.t)
                    of.append(Motion(entry.t, goal, entry.position_counts or 0, turned=True))
                    unread.add(entry.joint)
    found.pop("", None)
    return found


class Drive:
    """The last command of a drive: it reports that it starts, but not where to."""

    def __init__(self) -> None:
        self._word = self._goal = 0
        self._unread = False
        """See `motions_of`."""

    def take(self, entry: LogEntry, of: list[Motion]) -> None:
        """Add to its motions what an entry of its log says."""
        going, at = bool(of) and of[-1].rests == inf, (entry.position_counts or 0) + _CENTRE
        match entry.kind, entry.name:
            case "event", "motion_started" if not going and self._unread:
                self._unread = False
                of[-1] = of[-1]._replace(rests=inf)
            case "event", "motion_started" if not going:
                of.append(Motion(entry.t, self._goal, at, stopped=_stops(self._word)))
            case "event", "at_rest" | "torque_off" | "rebooted" if going:
                of[-1] = of[-1]._replace(rests=entry.t)
                if entry.name != "at_rest" or _there(of[-1], at):
                    self._unread = False
            case "instruction", _ if entry.registers[:2] == ("controlword", "target_position"):
                before, self._word = self._word, int.from_bytes(entry.data[:2], "little")
                self._unread &= not _stops(self._word)
                if self._word & ~before & _GO:
                    self._goal = int.from_bytes(entry.data[2:6], "little", signed=True) + _CENTRE
                    self._unread = going
                    if going:
                        of[-1] = of[-1]._replace(rests=entry.t)
                        of.append(Motion(entry.t, self._goal, at, turned=True))
                elif going and _stops(self._word):
                    of[-1] = of[-1]._replace(stopped=True)


def _there(motion: Motion, counts: int) -> bool:
    return abs(motion.counts - counts) <= _FAR_COUNTS


def _stops(word: int) -> bool:
    return bool(word & _HALT) or word & (_QUICK_STOP | _NO_QUICK_STOP) == _QUICK_STOP


def _written(entry: LogEntry, address: int) -> int | None:
    at = address - (entry.address or 0)
    return int.from_bytes(entry.data[at : at + 4], "little", signed=True) if 0 <= at <= len(entry.data) - 4 else None


def _unanswered(known: dict[type, list[Any]], killed: set[str]) -> list[str]:
    answered = {answer.number: answer.t for answer in known[Answer]}
    found: list[str] = []
    for order in known[Order]:
        late_s = answered.get(order.number, inf) - order.t - order.deadline_s
        late_s -= _frozen_s(known[Fault], order)
        if late_s > _ANSWERED_S and _who(order.number) not in killed:
            found.append(f"{order.number} ordered at {order.t:.3f}, answered {late_s:.1f} s after its deadline")
    return found


def _not_rescued(known: dict[type, list[Any]]) -> list[str]:
    """Stops that did not get through although strangers at the ports were the only trouble."""
    found: list[str] = []
    for rescue in known[Rescue]:
        others = (fault for fault in known[Fault] if fault.what in _IN_THE_WAY)
        if not rescue.through and not any(_overlaps(rescue, fault) for fault in others):
            found.append(f"no stop got through to {rescue.whom} at {rescue.t:.3f}: {rescue.said}")
    return found


def _not_latched(known: dict[type, list[Any]], motions: Mapping[str, Sequence[Motion]]) -> list[str]:
    """Motions that began although their robot had confirmed an e-stop whose clearing had not begun.

    A driver that starts while its disk is full finds no notes of what is open.
    """
    found: list[str] = []
    for alarm in known[Alarm]:
        if any(fault.what == "disk" and fault.t < alarm.until and fault.until > alarm.since for fault in known[Fault]):
            continue
        for resource, of in motions.items():
            for motion in of if resource.startswith(f"{alarm.robot}.") else ():
                if alarm.t < motion.t < alarm.until and motion.far > _FAR_COUNTS:
                    found.append(f"{resource} goes to {motion.counts} at {motion.t:.3f} while an e-stop is open")
    return found


def _overlaps(rescue: Rescue, fault: Fault) -> bool:
    """What was killed comes back, and what is back finds the others, within some time."""
    until = fault.t if fault.what.startswith("kill") else fault.until
    return fault.t < rescue.until and until + _BACK_S > rescue.t


def _frozen_s(faults: Sequence[Fault], order: Order) -> float:
    """For how long, since then, the client that ordered it did not run."""
    return sum(
        fault.until - max(fault.t, order.t)
        for fault in faults
        if fault.until > order.t and (fault.what, fault.whom) == ("freeze client", _who(order.number))
    )


def _held_up_s(faults: Sequence[Fault], order: Order) -> float:
    """For how long, since then, the HTTP gateway did not run that a page comes by: it counts from when it has heard."""
    if _kind(order.number) != "page":
        return 0.0
    frozen = (fault for fault in faults if fault.what == "freeze http gateway" and fault.until > order.t)
    return sum(fault.until - max(fault.t, order.t) for fault in frozen)


def _who(number: str) -> str:
    return number.partition(":")[0]


def _kind(number: str) -> str:
    """Planner, page or agent: names are of that and its number."""
    return _who(number).partition("-")[0].rstrip("0123456789")


def _motions(
    resource: str, motions: Sequence[Motion], orders: Sequence[Order], owned: Sequence[Owned], faults: Sequence[Fault]
) -> tuple[list[str], int]:
    """What was wrong, and how many orders were carried out."""
    found: list[str] = []
    done = Counter[str]()
    before: tuple[Motion, Order | None] | None = None
    times = [order.t for order in orders]
    since = [span.since for span in owned]
    for motion in motions:
        at = f"{resource} goes to {motion.counts} at {motion.t:.3f}"
        earlier = orders[: bisect_right(times, motion.t)]
        order = next((order for order in reversed(earlier) if order.counts == motion.counts), None)
        last, before = before, (motion, order)
        if motion.far <= _FAR_COUNTS:  # it may be a stop that happens to end there
            continue
        if order is None:
            found.append(f"{at}, {motion.far} counts away: no client ordered that")
            continue
        if last is not None and last[1] is not None and motion.turned and _broken_into(motion, order, *last):
            found.append(f"{at} for {order.hold}, while it moves for {last[1].hold}")
        done[order.number] += 1
        if done[order.number] > 1:
            found.append(f"{at}: {order.number} is done again")
        if motion.t > order.t + order.deadline_s + _held_up_s(faults, order):
            found.append(f"{at}: {order.number} is done after its deadline of {order.deadline_s:g} s")
        span = owned[bisect_right(since, motion.t) - 1] if since and since[0] <= motion.t else None
        if span is not None and whole(span.hold) != order.hold and motion.t < span.until:
            found.append(f"{at} for {order.hold} while {span.hold} had it")
        found += _continues(at, motion, order, resource, faults)
    return found, len(done)


def _broken_into(motion: Motion, order: Order, last: Motion, its: Order) -> bool:
    """Whether it took the joint from another client, under a lock of either, without a stop in between."""
    free = its.hold.endswith(_FREE) and order.hold.endswith(_FREE)
    under_way = abs(motion.at - last.counts) > _FAR_COUNTS and not last.stopped
    return under_way and not free and _who(its.number) != _who(order.number)


def _continues(at: str, motion: Motion, order: Order, resource: str, faults: Sequence[Fault]) -> list[str]:
    """Whether it continued although the client that ordered it, or the driver, was gone for long enough."""
    found: list[str] = []
    if order.valid_s and motion.rests - motion.t > order.valid_s + WATCHED_S:
        found.append(f"{at} and on for {motion.rests - motion.t:.1f} s, which was to hold for {order.valid_s:g} s")
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
        case "kill client":
            return STOPS_S if fault.whom == _who(order.number) else None
        case "freeze client":  # an agent says nothing while it waits: its host cannot tell that it is frozen
            mine = fault.whom == _who(order.number) and _kind(order.number) != "agent"
            return STOPS_S if mine else None
        case "kill http gateway" | "freeze http gateway":
            return STOPS_S if _kind(order.number) == "page" else None
        case "kill gateway" | "freeze gateway" | "cut" | "one way":
            return STOPS_S
        case "bus off":
            return WATCHED_S if resource.startswith(f"{fault.whom}.{CAN_BUS}.") else None
        case "kill driver" | "freeze driver" | "unplug":
            return WATCHED_S if fault.whom == robot else None
        case _:
            return None
