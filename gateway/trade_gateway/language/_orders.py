"""The orders: each plans calls of ordinary services, with the rights of who asks, and makes them once confirmed."""

from collections.abc import Callable, Mapping, Sequence
from typing import Final

from trade import Container, Handle, Outcome, where
from trade_gateway.language._names import in_words, one_container, place, provider_of
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

_PORT: Final = 7450


def permitted(container: Container, handle: Handle) -> Handle:
    """Raises AccessDenied before a user is asked to confirm a call that the policy known here does not allow."""
    own = container.address.identity
    container.access.require_call(own, handle.key.domain, handle.name, handle.effect, handle.label)
    return handle


def _functions(requester: Requester, name: str, containers: Sequence[str]) -> list[Handle]:
    """The middleware's service of that name in each of these containers. Raises Unknown, AccessDenied."""
    found = requester.container.services(where(name=name, group="trade") & ~where.local)
    found = [permitted(requester.container, handle) for handle in found if handle.container in containers]
    if not found:
        raise Unknown(f"no container offers trade.{name}{f' of {in_words(containers)}' if containers else ''}")
    return found


def _done(outcomes: Sequence[Outcome]) -> Answer:
    """The result of a call in several containers; raises the first error if none succeeded."""
    done = [outcome.handle.container for outcome in outcomes if outcome.ok]
    failed = {outcome.handle.container: str(outcome.error) for outcome in outcomes if not outcome.ok}
    if failed and not done:
        raise next(outcome.error for outcome in outcomes if outcome.error is not None)
    shown = [in_words(sorted(done)), *(f"it failed in {name}: {why}" for name, why in sorted(failed.items()))]
    return Answer(len(done), {"count": len(done), "report": "; ".join(shown)}, {"done": sorted(done), "failed": failed})


# --- links


def _switch(name: str, *, on: bool) -> Callable[[Requester, Gaps], Plan]:
    def plan(requester: Requester, gaps: Gaps) -> Plan:
        there = place(requester, gaps.get("place"))
        asked = _functions(requester, f"set_{name}", [info.name for info in there.containers])
        containers = in_words(sorted(handle.container for handle in asked))
        shall = f"turn {'on' if on else 'off'} {name} in {containers}"
        return Plan(shall, lambda: _done(requester.container.call_all(asked, on)))

    return plan


def _link(name: str, word: str) -> Callable[[Requester, Gaps], Plan]:
    def plan(requester: Requester, gaps: Gaps) -> Plan:
        there = one_container(requester, gaps.get("place"))
        [asked] = _functions(requester, name, [there.name])[:1]
        endpoint = gaps["endpoint"]
        if name == "connect" or endpoint not in {info.name for info in requester.container.containers()}:
            endpoint = _endpoint(requester, endpoint)
        call = asked.bind(endpoint)
        return Plan(f"{name} {there.name} {word} {endpoint}", lambda: _done(requester.container.call_all([call])))

    return plan


def _endpoint(requester: Requester, said_: str) -> str:
    """The endpoint in full: without a protocol or a port, those of this system's containers and of the guide."""
    if "/" in said_:
        return said_
    protocol = "tcp" if requester.container.settings.tls is None else "tls"
    host, _, port = said_.rpartition(":")
    if not host or "]" in port:  # an IPv6 address without a port
        host, port = said_, str(_PORT)
    return f"{protocol}/{host}:{port}"


# --- providers and containers


def _instantiate(requester: Requester, gaps: Gaps) -> Plan:
    kind = gaps["kind"]
    if ":" not in kind:
        problem = f"I do not know the class of {kind!r}. Say its path, such as mypkg.vision:Camera, or give it a name"
        raise Unknown(f"{problem} in a lexicon file: [name] with {kind!r} = 'mypkg.vision:Camera'")
    there = one_container(requester, gaps.get("place"))
    [asked] = _functions(requester, "instantiate", [there.name])[:1]
    groups = (gaps["group"],) if "group" in gaps else ()

    def do() -> Answer:
        made = asked(kind, (), groups)
        labels = sorted(handle.label for handle in made)
        return Answer(len(labels), {"count": len(labels), "report": in_words(labels)}, labels)

    return Plan(f"create {kind} in container {there.name}{f' as {groups[0]}' if groups else ''}", do)


def _terminate(requester: Requester, gaps: Gaps) -> Plan:
    provider = provider_of(requester, gaps["group"])
    [asked] = _functions(requester, "terminate", [provider.container])[:1]
    what = f"the provider of {provider.groups[0] if provider.groups else provider.label}"
    return Plan(f"end {what} in container {provider.container}", lambda: done(what, asked(provider)))


def _migrate(requester: Requester, gaps: Gaps) -> Plan:
    provider = provider_of(requester, gaps["group"])
    source = place(requester, gaps.get("source"))
    if provider.container not in [info.name for info in source.containers]:
        raise Unknown(f"{gaps['group']} is not in {source.text}, but in container {provider.container}")
    there = one_container(requester, gaps["place"], without=provider.container)
    name = provider.groups[0] if provider.groups else provider.label

    def do() -> Answer:
        moved = requester.container.migrate(provider, to=there.name)
        labels = sorted(handle.label for handle in moved)
        return Answer(len(labels), {"count": len(labels), "report": f"{in_words(labels)} in {there.name}"}, labels)

    return Plan(f"move {name} from container {provider.container} to container {there.name}", do)


def _restart(requester: Requester, gaps: Gaps) -> Plan:
    asked = requester.container.services(where(name="children", group="trade") & ~where.local)
    outcomes = requester.container.call_all(asked)
    failed = next((outcome.error for outcome in outcomes if outcome.error is not None), None)
    children = sorted({(info.name, outcome.handle.container) for outcome in outcomes for info in outcome.result or ()})
    wanted = gaps["container"].lower()
    spelled = {wanted, wanted.replace(" ", "-"), wanted.replace(" ", "_"), wanted.replace(" ", ".")}
    found = [(name, gateway) for name, gateway in children if name.lower() in spelled]
    if not found and failed is not None:
        raise failed
    if not found:
        known = in_words([name for name, _ in children]) or "none"
        raise Unknown(f"no gateway restarts {gaps['container']!r}; gateways here restart these containers: {known}")
    if len(found) > 1:
        raise Unknown(f"several gateways restart {found[0][0]}: {in_words([gateway for _, gateway in found])}")
    [(name, gateway)] = found
    [restart] = _functions(requester, "restart_child", [gateway])[:1]
    return Plan(f"restart container {name} by gateway {gateway}", lambda: done(name, restart(name)))


def _end_container(requester: Requester, gaps: Gaps) -> Plan:
    try:
        there = one_container(requester, f"container {gaps['container']}")
    except Ambiguous as which:
        raise Ambiguous("container", [one.removeprefix("container ") for one in which.choices]) from None
    [asked] = _functions(requester, "terminate_container", [there.name])[:1]

    def do() -> Answer:
        return done(there.name, asked(PURPOSE, only_at_rest=True))

    return Plan(f"end container {there.name}, if it is at rest and not locked", do)


ORDERS: Final[Mapping[str, Request]] = {
    "discovery_on": order(("place",), _switch("discovery", on=True)),
    "discovery_off": order(("place",), _switch("discovery", on=False)),
    "broadcast_on": order(("place",), _switch("broadcast", on=True)),
    "broadcast_off": order(("place",), _switch("broadcast", on=False)),
    "connect": order(("endpoint", "place"), _link("connect", "to")),
    "disconnect": order(("endpoint", "place"), _link("disconnect", "from")),
    "instantiate": order(("kind", "place", "group"), _instantiate),
    "terminate": order(("group",), _terminate),
    "migrate": order(("group", "place", "source"), _migrate),
    "restart": order(("container",), _restart),
    "end_container": order(("container",), _end_container),
}
"""By their names in the lexicon."""
