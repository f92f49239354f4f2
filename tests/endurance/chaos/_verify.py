"""The judge: a pure function from what was recorded to what was wrong. It knows nothing of how locks are made."""

import itertools
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Iterable

from tests.endurance.chaos._records import AnyRecord, Beat, Byte, Command, End, Fault, Grant, Renewed
from tests.support.lock_log import Done, Owned, Verdict, asks_without_end, by_kind, owned, two_owners

_BEAT_S = 0.05
"""How far apart a driver's signs of life are meant to be."""
_LEASES = 2.0
"""So many leases after the last renewal a grant must have ended, not counting the time its driver did not have."""
Place = tuple[str, str]
"""An epoch and a resource, or an epoch and the number of a grant."""


def verify(records: Iterable[AnyRecord]) -> Verdict:
    """Look for two owners, bytes of who must not write, grants that outlive their lease, asks without end."""
    known = by_kind(records)
    verdict = Verdict()
    for kind, those in known.items():
        if kind is not Beat:
            verdict.counts[kind.__name__.lower()] = len(those)
    verdict.counts.update(f"fault {fault.what}" for fault in known[Fault])
    verdict.counts.update(f"done {done.how}" for done in known[Done])
    surely = owned(known)
    verdict.violations += two_owners(surely)
    verdict.violations += _foreign_bytes(surely, known[Byte])
    verdict.violations += _bytes_after_a_newer_grant(known[Grant], known[Byte])
    verdict.violations += _commands_without_a_grant(known[Grant], known[End], known[Command])
    verdict.violations += _grants_that_outlive_their_lease(known)
    killed = {fault.process for fault in known[Fault] if fault.what == "kill"}
    verdict.violations += asks_without_end(known, killed)
    return verdict


def _foreign_bytes(owned: dict[str, list[Owned]], sent: list[Byte]) -> list[str]:
    starts = {resource: [span.since for span in spans] for resource, spans in owned.items()}
    found: list[str] = []
    for byte in sent:
        index = bisect_right(starts.get(byte.resource, []), byte.t) - 1
        if index < 0:
            continue
        span = owned[byte.resource][index]
        if byte.t < span.until and byte.hold != span.hold:
            found.append(f"{byte.resource} got a byte of {byte.hold} at {byte.t:.6f} while {span.hold} had it")
    return found


def _bytes_after_a_newer_grant(grants: list[Grant], sent: list[Byte]) -> list[str]:
    times: dict[Place, list[float]] = defaultdict(list)
    for grant in sorted(grants, key=lambda grant: grant.t):
        for resource in grant.resources:
            times[grant.epoch, resource].append(grant.t)
    found: list[str] = []
    for byte in sent:
        granted = times[byte.epoch, byte.resource]
        if bisect_right(granted, byte.t) > bisect_right(granted, byte.command_t):
            found.append(f"{byte.resource} got a byte of {byte.hold} at {byte.t:.6f}, after a newer grant")
    return found


def _commands_without_a_grant(grants: list[Grant], ends: list[End], commands: list[Command]) -> list[str]:
    """What passed the gate under a grant that had ended, or without one while one held."""
    ended = {(end.epoch, end.number): end for end in ends}
    of: dict[Place, list[Grant]] = defaultdict(list)
    for grant in grants:
        for resource in grant.resources:
            of[grant.epoch, resource].append(grant)
    found: list[str] = []
    for command in commands:
        here = of[command.epoch, command.resource]
        shown = [grant for grant in here if grant.number in command.grants]
        for grant in shown:
            end = ended.get((grant.epoch, grant.number))
            if end is not None and command.t > end.after_t:
                found.append(f"{_of(command)}, after its grant had ended")
        for grant in here if not shown else ():
            end = ended.get((grant.epoch, grant.number))
            if grant.t < command.t and end is not None and command.t < end.t and command.resource in grant.resources:
                found.append(f"{_of(command)}, without the grant that held")
    return found


def _of(command: Command) -> str:
    return f"{command.hold} commanded {command.resource} at {command.t:.6f}"


def _grants_that_outlive_their_lease(known: dict[type, list]) -> list[str]:
    beats: dict[str, list[float]] = defaultdict(list)
    for beat in known[Beat]:
        beats[beat.epoch].append(beat.t)
    ended = {(end.epoch, end.number): end.t for end in known[End]}
    renewed: dict[tuple[str, int], float] = {}
    for renewal in known[Renewed]:
        for number in renewal.numbers:
            renewed[renewal.epoch, number] = max(renewal.t, renewed.get((renewal.epoch, number), renewal.t))
    found: list[str] = []
    for grant in known[Grant]:
        of = (grant.epoch, grant.number)
        last = max(grant.t, renewed.get(of, grant.t))
        signs = sorted(beats[grant.epoch])
        until = ended.get(of, signs[-1] if signs else last)
        lasted_s = until - last - _not_had(signs, last, until)
        if lasted_s > _LEASES * grant.lease_s:
            found.append(
                f"grant {grant.number} lasted {lasted_s:.2f} s after its last lease of {grant.lease_s:g} s began"
            )
    return found


def _not_had(signs: list[float], since: float, until: float) -> float:
    """For how long, in that time, the driver's process did not run."""
    around = signs[max(0, bisect_right(signs, since) - 1) : bisect_right(signs, until) + 1]
    gaps = itertools.pairwise([*around, until])  # a process that has to end as it is thawed gives no more signs
    return sum(max(0.0, min(later, until) - max(earlier, since) - _BEAT_S) for earlier, later in gaps)
