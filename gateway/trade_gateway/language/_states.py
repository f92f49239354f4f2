"""The questions about the state of a system: why something is stopped, who may move it, and what a loss would stop."""

import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

import msgspec

from trade import Handle, where
from trade.auditing import AuditRow, reading, records_in
from trade.protocol.messages import HEALTHY
from trade.timestamps import clock
from trade_gateway.language._names import in_words, matching, others, place, resources
from trade_gateway.language._requests import Answer, Gaps, Request, Requester, Unknown

_ROWS: Final = 5_000
"""How many of the last rows of an audit record are read."""
_ANSWER_S: Final = 2.0
"""How long a container may take to list its stops, in seconds."""


# --- why


def _why(requester: Requester, gaps: Gaps) -> Answer:
    found = matching(requester.container, gaps)
    wanted = resources(handle for handle in found if handle.effect == "actuate")
    reasons = [
        f"an e-stop is open, by {one.giver}, since {clock(one.at)}{f': {one.reason}' if one.reason else ''}"
        for one in requester.container.estops()
    ]
    reasons += _stops(requester, [handle for handle in found if handle.effect == "actuate"], wanted)
    bad = {f"{(handle.groups or (handle.label,))[0]} is {handle.health}" for handle in found}
    reasons += sorted(text for text in bad if not text.endswith(f" is {HEALTHY}"))
    known = requester.container.lock_api.known()
    held = [info for info in known.locks if not wanted.isdisjoint(info.resources)]
    reasons += [f"{', '.join(info.resources)} {info.holder.purpose}" for info in held if not info.token.number]
    reasons += [f"{info.holder.owner} has locked {', '.join(info.resources)}" for info in held if info.token.number]
    reasons += [f"of {silent.container} it is not known, it does not answer" for silent in known.silent]
    noted = _noted(requester.audit, found)
    fields = {"count": len(reasons), "reasons": "; ".join([*reasons, *noted]), "noted": "; ".join(noted)}
    return Answer(len(reasons), fields, [*reasons, *noted])


def _stops(requester: Requester, found: Iterable[Handle], wanted: set[str]) -> list[str]:
    """The stops that hold these resources; an e-stop only if it was cleared, and the resource waits for `resume`."""
    addresses = {handle.key.address for handle in found}
    asked = requester.container.services(where(name="stops", group="trade") & ~where.local)
    asked = [handle.with_(deadline_s=_ANSWER_S) for handle in asked if handle.key.address in addresses]
    answered = [outcome for outcome in requester.container.call_all(asked) if outcome.ok]
    stops: dict[tuple[str, str], list[str]] = {}
    for info in [info for outcome in answered for info in outcome.result]:
        if info.resource in wanted and not info.estop:
            stops.setdefault((info.by, info.reason), []).append(info.resource)
    shown = [
        f"{by} stopped {in_words(sorted(names))}: {why}; `resume` lets it move" for (by, why), names in stops.items()
    ]
    silent = addresses - {outcome.handle.key.address for outcome in answered}
    return shown + sorted(f"the stops in {address.container} are not known" for address in silent)


def _noted(folder: Path | None, found: Iterable[Handle]) -> list[str]:
    """The last stop of these services in the audit records of this host."""
    labels = {handle.label for handle in found if handle.effect == "stop"}
    rows = [row for row in _last_rows(folder) if row.kind == "stop" and row.what in labels]
    if not rows:
        return []
    last = max(rows, key=lambda row: row.at_ns)
    outcome = "" if last.outcome == "ok" else f", which ended with {last.outcome}"
    return [f"the audit has a call of {last.what} by {last.who} at {clock(last.at_ns / 1e9)}{outcome}"]


def _last_rows(folder: Path | None) -> Iterator[AuditRow]:
    for path in [] if folder is None or not folder.is_dir() else records_in(folder):
        try:
            with reading(path) as (end, _):
                after = max(0, end.seq - _ROWS)
            with reading(path, after) as (_, links):
                yield from [link.row for link in links]
        except (OSError, sqlite3.Error, msgspec.ValidationError):  # a damaged record: `trade audit verify` reports it
            continue


# --- who may


def _movers(requester: Requester, gaps: Gaps) -> Answer:
    moved = [handle for handle in matching(requester.container, gaps) if handle.effect == "actuate"]
    if not moved:
        raise Unknown(f"{gaps['group']} has no service that moves it")
    locked = _held(requester, resources(moved))
    policy = requester.container.access.policy
    if policy is None:
        text = f"I know of no policy, so every client of the system may{locked}"
        return Answer(1, {"count": 1, "who": text}, None)
    here = {info.identity for info in requester.container.containers()}
    known = sorted({*policy.names(), *policy.patterns(), *here})
    domains = {handle.key.domain for handle in moved}
    able = [name for name in known if all(policy.decide(name, "call", domain).allowed for domain in domains)]
    own = requester.container.address.identity
    text = f"by {policy.source}, {in_words(able) or 'no identity'} may. You are {own}{locked}"
    return Answer(len(able), {"count": len(able), "who": text}, able)


def _held(requester: Requester, wanted: set[str]) -> str:
    """Who has locked these, as an addition to a sentence."""
    locks = requester.container.lock_api.known().locks
    owners = sorted({info.holder.owner for info in locks if not wanted.isdisjoint(info.resources)})
    return f". Now only {in_words(owners)} can, under a lock" if owners else ""


# --- what if


def _loss(requester: Requester, gaps: Gaps) -> Answer:
    there = place(requester, gaps["place"])
    lost = {info.epoch for info in there.containers}
    handles = others(requester.container)
    gone = sorted({handle.label for handle in handles if handle.key.address.epoch in lost})
    left = {handle.label for handle in handles if handle.key.address.epoch not in lost}
    known = requester.container.lock_api.known()
    there_used = resources(handle for handle in handles if handle.key.address.epoch in lost)
    sessions = {f"{info.identity}/{info.name}" for info in there.containers}
    locks = sorted(
        {
            f"{', '.join(info.resources)} of {info.holder.owner}"
            for info in known.locks
            if info.token.epoch in lost or info.holder.owner in sessions or not there_used.isdisjoint(info.resources)
        }
    )
    data = {"containers": [info.name for info in there.containers], "services": gone, "locks": locks}
    shown = _parts(data, kept=[label for label in gone if label in left])
    shown += [f"of the locks in {silent.container} it is not known, it does not answer" for silent in known.silent]
    return Answer(len(gone), {"count": len(gone), "place": there.text, "losses": "; ".join(shown)}, data)


def _parts(data: Mapping[str, Sequence[str]], kept: Sequence[str]) -> list[str]:
    shown = [f"{'containers' if len(data['containers']) > 1 else 'container'} {in_words(data['containers'])}"]
    if gone := data["services"]:
        shown.append(f"{len(gone)} {'services' if len(gone) > 1 else 'service'}: {in_words(gone)}")
        if kept:
            shown.append(f"another container also offers {in_words(kept)}")
    if locks := data["locks"]:
        shown.append(f"{'locks' if len(locks) > 1 else 'a lock'}: {in_words(locks)}")
    return shown


STATES: Final[Mapping[str, Request]] = {
    "why": Request(("group",), ("count", "reasons", "noted"), _why),
    "movers": Request(("group",), ("count", "who"), _movers),
    "loss": Request(("place",), ("count", "place", "losses"), _loss),
}
"""By their names in the lexicon."""
