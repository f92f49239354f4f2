"""The orders about motion: locks, stops, and what lets things move again."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from itertools import repeat
from typing import Final

from trade import where
from trade_gateway.language._names import groups_named, in_words, one_group, resources
from trade_gateway.language._requests import (
    PURPOSE,
    Ambiguous,
    Answer,
    Gaps,
    Plan,
    Request,
    Requester,
    Unknown,
    done,
    order,
)

_LOCK_WAIT_S: Final = 5.0


# --- locks


def _lock(requester: Requester, gaps: Gaps) -> Plan:
    group = one_group(requester, gaps["group"])
    if not requester.keeps:
        problem = f"a lock of {group} would end with this command, so it was not taken. Say it in a dialogue"
        raise Unknown(f"{problem} (`trade ask` alone), or run a program under it: `trade lock {group} -- COMMAND`")

    held = {name for lock in requester.locks if lock.held for name in lock.resources}
    moved = [handle for handle in requester.container.services(where(group=group)) if handle.effect == "actuate"]
    if moved and held >= resources(moved):
        raise Unknown(f"you have {group} already")

    def do() -> Answer:
        taken = requester.container.lock(group, purpose=PURPOSE, wait_s=_LOCK_WAIT_S).acquire()
        requester.locks.append(taken)
        return Answer(len(taken.resources), {"count": len(taken.resources), "report": in_words(taken.resources)}, group)

    return Plan(f"lock {group}", do, confirm=False)


def _release(requester: Requester, gaps: Gaps) -> Plan:
    _require_locks(requester)
    words = gaps.get("group", "")
    held = [(in_words(lock.resources), lock) for lock in requester.locks]
    if words and words not in [name for name, _ in held]:
        group = one_group(requester, words)
        used = resources(requester.container.services(where(group=group)))
        held = [(name, lock) for name, lock in held if not used.isdisjoint(lock.resources)]
        if not held:
            mine = "; ".join(in_words(lock.resources) for lock in requester.locks)
            raise Unknown(f"I hold no lock of {group}. I hold {mine}")
    elif words:
        held = [(name, lock) for name, lock in held if name == words]
    if len(held) > 1:
        raise Ambiguous("group", [name for name, _ in held])
    [(name, lock)] = held

    def do() -> Answer:
        requester.locks.remove(lock)
        lock.release()
        return done(name)

    return Plan(f"release {name}", do, confirm=False)


def _release_all(requester: Requester, _gaps: Gaps) -> Plan:
    _require_locks(requester)
    names = in_words([in_words(lock.resources) for lock in requester.locks])

    def do() -> Answer:
        while requester.locks:
            requester.locks.pop().release()
        return done(names)

    return Plan(f"release {names}", do, confirm=False)


def _require_locks(requester: Requester) -> None:
    if not requester.locks:
        raise Unknown("I hold no lock. `trade locks` lists the locks of others, and `trade unlock` breaks one")


# --- stops


def _stop(requester: Requester, gaps: Gaps) -> Plan:
    try:
        groups = groups_named(requester, gaps["group"])
    except Unknown as unknown:
        raise Unknown(f"{unknown}. Nothing was stopped; `stop` alone stops everything") from None

    def do() -> Answer:
        with ThreadPoolExecutor(len(groups), "trade-ask-stop") as at_once:
            reports = list(at_once.map(requester.container.stop, groups, repeat(gaps.get("reason", PURPOSE))))
        stopped = sorted({name for report in reports for name in report.stopped})
        failed = {name: why for report in reports for name, why in report.failed.items()}
        shown = [f"stopped: {in_words(stopped)}"] if stopped else []
        shown += [f"FAILED: {name}: {why}" for name, why in sorted(failed.items())]
        empty = [report.group for report in reports if not (report.stopped or report.failed)]
        shown += [f"FAILED: {group} has nothing that can be stopped" for group in empty]
        return Answer(len(stopped), {"count": len(stopped), "report": "; ".join(shown)}, reports)

    return Plan(f"stop {in_words(groups)}", do, confirm=False, stops=True)


def _estop(requester: Requester, gaps: Gaps) -> Plan:
    def do() -> Answer:
        report = requester.container.estop(gaps.get("reason", "requested in a sentence"))
        troubles = [f"{name} did not answer" for name in report.missing]
        troubles += [f"{name} failed: {why}" for name, why in report.failed.items()]
        shown = f"confirmed by {in_words(report.confirmed) or 'none'}{'; ' if troubles else ''}{'; '.join(troubles)}"
        count = len(report.confirmed)
        return Answer(count, {"count": count, "report": shown, "id": report.id}, report)

    return Plan("stop the whole system", do, confirm=False, stops=True)


def _resume(requester: Requester, gaps: Gaps) -> Plan:
    group = one_group(requester, gaps["group"])

    def do() -> Answer:
        resumed = sorted(requester.container.resume(group))
        return Answer(len(resumed), {"count": len(resumed), "report": in_words(resumed)}, resumed)

    return Plan(f"let {group} move again", do)


def _clear(requester: Requester, _gaps: Gaps) -> Plan:
    ids = [one.id for one in requester.container.estops()]
    if not ids:
        raise Unknown("no e-stop is open")

    def do() -> Answer:
        report = requester.container.estop_clear(ids)
        troubles = [*report.missing, *report.failed]
        shown = f"{in_words(ids)}{f'; not in {in_words(troubles)}' if troubles else ''}"
        return Answer(len(ids), {"count": len(ids), "report": shown}, report)

    return Plan(f"clear e-stop {in_words(ids)}", do)


MOTION_ORDERS: Final[Mapping[str, Request]] = {
    "lock": order(("group",), _lock),
    "release": order(("group",), _release),
    "release_all": order((), _release_all),
    "stop": order(("group", "reason"), _stop),
    "estop": Request(("reason",), ("count", "report", "id"), _estop, is_order=True),
    "resume": order(("group",), _resume),
    "clear": order((), _clear),
}
"""By their names in the lexicon."""
