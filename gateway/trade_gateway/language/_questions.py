"""The questions about services, containers and locks: each makes look-ups and calls that any program could make."""

import re
from collections.abc import Iterator, Mapping
from typing import Any, Final

from trade import where
from trade.errors import AccessDenied, ConfigurationError
from trade.protocol.messages import HEALTHY
from trade.timestamps import clock
from trade_gateway.language._names import in_words, matching, names, one_of, others, resources
from trade_gateway.language._requests import Answer, Gaps, Request, Requester, Unknown

_ARTICLES: Final = ("a", "an", "the", "my", "some")
_ANYTHING: Final = ("anything", "something", "things", "objects", "it", "them")
_LITTLE: Final = ("at", "for", "from", "in", "into", "of", "off", "on", "onto", "out", "to", "up", "with")


def _services(requester: Requester, gaps: Gaps) -> Answer:
    return names(sorted({handle.label for handle in matching(requester.container, gaps)}))


def _containers(requester: Requester, gaps: Gaps) -> Answer:
    container = requester.container
    host = one_of("host", gaps.get("host"), [handle.host for handle in others(container)])
    infos = [info for info in container.containers() if info.epoch != container.address.epoch]
    return names(sorted(info.name for info in infos if host in ("", info.host)))


def _hosts(requester: Requester, _gaps: Gaps) -> Answer:
    own = requester.container.address.epoch
    return names(sorted({info.host for info in requester.container.containers() if info.epoch != own}))


def _place(requester: Requester, gaps: Gaps) -> Answer:
    places = sorted({(handle.container, handle.host) for handle in matching(requester.container, gaps)})
    shown = in_words([f"container {name} on host {host}" for name, host in places])
    data = [{"container": name, "host": host} for name, host in places]
    return Answer(len(places), {"count": len(places), "places": shown}, data)


def _able(requester: Requester, gaps: Gaps) -> Answer:
    goal = gaps["goal"]
    for predicate in [goal] if "(" in goal else _predicates(goal):
        try:
            found = requester.container.services(where(achieves=predicate))
        except ConfigurationError as bad:
            raise Unknown(f"{goal!r} is not a predicate such as see(?x): {bad.problem}") from None
        if found:
            return names(sorted({handle.label for handle in found}))
    return names([])


def _predicates(goal: str) -> Iterator[str]:
    """The predicates that a goal in words may mean: "see a mug" is see(mug), "pick up the cup" is pick_up(cup)."""
    words = [word for word in re.split(r"[\s._,]+", goal.lower()) if word]
    starts = [at for at, word in enumerate(words) if word in _ARTICLES and at]
    verb = words[: starts[0]] if starts else words
    if not starts:  # no article says where the object begins
        yield f"{'_'.join(words)}(?x)"
        yield "_".join(words)
    for end in [len(verb)] if starts else range(1, len(words)):
        parts = _objects(words[end:])
        if parts:
            yield f"{'_'.join(words[:end])}({', '.join(parts)})"


def _objects(words: list[str]) -> list[str]:
    """The objects of a verb: "the red cup on a table" is red_cup and table."""
    found: list[list[str]] = [[]]
    for word in words:
        if word in _LITTLE:
            found.append([])
        elif word not in _ARTICLES:
            found[-1].append(word)
    parts = ["_".join(part) for part in found if part]
    return [f"?{at}" if part in _ANYTHING else part for at, part in enumerate(parts)]


def _description(requester: Requester, gaps: Gaps) -> Answer:
    found = {handle.signature: handle for handle in matching(requester.container, gaps)}
    shown = "; ".join(f"{handle.label} is {sign}: {handle.doc or 'undocumented'}" for sign, handle in found.items())
    data = [{"service": handle.label, "signature": sign, "doc": handle.doc} for sign, handle in found.items()]
    return Answer(len(found), {"count": len(found), "descriptions": shown}, data)


def _needs(requester: Requester, gaps: Gaps) -> Answer:
    try:
        found = matching(requester.container, gaps)
    except Unknown:  # what is no service may be a group
        found = matching(requester.container, {"group": gaps["service"]})
    needs = sorted({(handle.label, need) for handle in found for need in handle.needs})
    met = {need: sorted({one.label for one in requester.container.services(where(achieves=need))}) for _, need in needs}
    shown = [f"{label} needs {need}, {_sources(met[need])}" for label, need in needs]
    data = [{"service": label, "needs": need, "achieved_by": met[need]} for label, need in needs]
    return Answer(len(shown), {"count": len(shown), "needs": "; ".join(shown)}, data)


def _sources(labels: list[str]) -> str:
    return f"which {in_words(labels)} can achieve" if labels else "which no service achieves"


def _locks(requester: Requester, gaps: Gaps) -> Answer:
    wanted = resources(matching(requester.container, gaps))
    known = requester.container.lock_api.known()
    held = [info for info in known.locks if not gaps or not wanted.isdisjoint(info.resources)]
    shown = [
        f"{info.holder.owner} has {', '.join(info.resources)}"
        + (f", for {info.holder.purpose!r}" if info.holder.purpose else "")
        + f", since {clock(info.holder.since)}"
        + (f"; {', '.join(info.waiting)} waits" if info.waiting else "")
        for info in held
    ]
    shown += [f"of {silent.container} it is not known, it does not answer" for silent in known.silent]
    data = [{"owner": info.holder.owner, "resources": info.resources, "purpose": info.holder.purpose} for info in held]
    return Answer(len(shown), {"count": len(held), "locks": "; ".join(shown)}, data)


def _unwell(requester: Requester, gaps: Gaps) -> Answer:
    bad = {(handle.groups or (handle.label,))[0]: handle.health for handle in matching(requester.container, gaps)}
    bad = {group: health for group, health in bad.items() if health != HEALTHY}
    stopped = [f"an e-stop is open, by {one.giver}{_because(one.reason)}" for one in requester.container.estops()]
    shown = [*stopped, *(f"{group}: {health}" for group, health in sorted(bad.items()))]
    return Answer(len(shown), {"count": len(shown), "problems": "; ".join(shown)}, shown)


def _estops(requester: Requester, _gaps: Gaps) -> Answer:
    found = requester.container.estops()
    shown = [f"{one.id} by {one.giver}, since {clock(one.at)}{_because(one.reason)}" for one in found]
    return Answer(len(found), {"count": len(found), "estops": "; ".join(shown)}, found)


def _because(reason: str) -> str:
    return f": {reason}" if reason else ""


def _news(requester: Requester, _gaps: Gaps) -> Answer:
    news = requester.memory.news({handle.label: handle.container for handle in others(requester.container)})
    if news is None:
        return Answer(1, {"count": 1, "news": "I have not looked before; from now on I know"}, None)
    came, gone = news
    shown = [f"{word}: {in_words(labels)}" for word, labels in (("new", came), ("gone", gone)) if labels]
    count = len(came) + len(gone)
    return Answer(count, {"count": count, "news": "; ".join(shown)}, {"came": came, "gone": gone})


def _load(requester: Requester, gaps: Gaps) -> Answer:
    infos, _ = _states(requester, "load", gaps)
    infos.sort(key=lambda info: -info.cpu_percent)
    shown = [f"{info.container} takes {info.cpu_percent:.0f} % of a core" for info in infos]
    busiest = infos[0].container if infos else ""
    return Answer(len(infos), {"count": len(infos), "loads": "; ".join(shown), "busiest": busiest}, infos)


def _links(requester: Requester, gaps: Gaps) -> Answer:
    infos, silent = _states(requester, "network", gaps)
    links = [(info.container, link.to or "something that is no container") for info in infos for link in info.links]
    pairs = {tuple(sorted(pair)) for pair in links if requester.container.name not in pair}
    shown = sorted(f"{one} is linked with {other}" for one, other in pairs) + silent
    return Answer(len(shown), {"count": len(pairs), "links": "; ".join(shown)}, infos)


def _switches(requester: Requester, gaps: Gaps) -> Answer:
    infos, silent = _states(requester, "network", gaps)
    shown = [
        f"{info.container} has discovery {'on' if info.discovery else 'off'} "
        f"and broadcasting {'on' if info.broadcast else 'off'}"
        for info in sorted(infos, key=lambda info: info.container)
    ] + silent
    return Answer(len(shown), {"count": len(infos), "switches": "; ".join(shown)}, infos)


def _states(requester: Requester, state: str, gaps: Gaps) -> tuple[list[Any], list[str]]:
    """What all other containers, or one of them, answer about a state, and sentences about those that do not."""
    present = requester.container.everywhere(state)
    asked, unlisted = [one for one in present.handles if not one.local], [one.container for one in present.silent]
    name = one_of("container", gaps.get("container"), [*(handle.container for handle in asked), *unlisted])
    asked = [handle for handle in asked if name in ("", handle.container)]
    outcomes = requester.container.call_all(asked)
    denied = next((outcome.error for outcome in outcomes if isinstance(outcome.error, AccessDenied)), None)
    if denied is not None:
        raise denied
    silent = [outcome.handle.container for outcome in outcomes if not outcome.ok]
    silent = sorted([*silent, *(one for one in unlisted if name in ("", one))])
    unknown = [f"of {one} it is not known, it does not answer" for one in silent]
    return [outcome.result for outcome in outcomes if outcome.ok], unknown


_WHICH: Final = ("group", "service", "container", "host")

QUESTIONS: Final[Mapping[str, Request]] = {
    "services": Request(_WHICH, ("count", "names"), _services),
    "containers": Request(("host",), ("count", "names"), _containers),
    "hosts": Request((), ("count", "names"), _hosts),
    "place": Request(_WHICH, ("count", "places"), _place),
    "able": Request(("goal",), ("count", "names"), _able),
    "description": Request(_WHICH, ("count", "descriptions"), _description),
    "needs": Request(("service",), ("count", "needs"), _needs),
    "locks": Request(_WHICH, ("count", "locks"), _locks),
    "unwell": Request(_WHICH, ("count", "problems"), _unwell),
    "estops": Request((), ("count", "estops"), _estops),
    "news": Request((), ("count", "news"), _news),
    "links": Request(("container",), ("count", "links"), _links),
    "switches": Request(("container",), ("count", "switches"), _switches),
    "load": Request(("container",), ("count", "loads", "busiest"), _load),
}
"""By their names in the lexicon."""
