"""The states of containers as tables: links, endpoints and switches, listeners of streams, and events."""

from collections.abc import Callable, Sequence
from datetime import datetime, timezone
from enum import Enum
from typing import Any, Final, NamedTuple

from msgspec import Struct

from trade import Container, LinkInfo, ListenerInfo, NetworkInfo, StateEvent
from trade.errors import AccessDenied
from trade.timestamps import clock
from trade_gateway.terminal._output import Output, complain

Row = tuple[str, ...]


class State(str, Enum):
    """A state that each container answers for."""

    LINKS = "links"
    NETWORK = "network"
    LISTENERS = "listeners"
    EVENTS = "events"


class _StateView(NamedTuple):
    """How a state is asked for and shown."""

    service: str
    columns: Row
    row: Callable[[Any], Row]
    nothing: str


class _ReportedLink(Struct, frozen=True):
    """A link, and the container that reports it."""

    container: str
    link: LinkInfo


def _ask_each(container: Container, name: str) -> list[Any]:
    """Returns what each other container answers to one of the middleware's functions.

    Containers that do not answer, for example of an earlier version, are reported on standard error.

    Raises:
        AccessDenied: one of them does not allow it.
    """
    present = container.everywhere(name)
    for address in present.silent:
        complain(f"{address.container} did not answer: it has not listed its services")
    outcomes = container.call_all([handle for handle in present.handles if not handle.local])
    for outcome in outcomes:
        if isinstance(outcome.error, AccessDenied):
            raise outcome.error
        if not outcome.ok:
            complain(f"{outcome.handle.container} did not answer: {outcome.error}")
    return [outcome.result for outcome in outcomes if outcome.ok]


def say_state(out: Output, container: Container, state: State) -> None:
    """Prints a state of all other containers."""
    shown, found = _STATES[state], list[Any]()
    for answer in _ask_each(container, shown.service):
        if state is State.LINKS:
            found += [_ReportedLink(answer.container, link) for link in answer.links if link.to != container.name]
        elif state is State.EVENTS:
            found += [event for event in answer if event.about != container.name]
        else:
            found += [answer] if state is State.NETWORK else answer
    if state is State.EVENTS:
        found.sort(key=_at)
    if out.as_json:
        out.data(found)
    elif found:
        out.table(shown.columns, [shown.row(one) for one in found])
    else:
        out.say(shown.nothing)


def _link(linked: _ReportedLink) -> Row:
    info = linked.link
    kind = f"{info.to or '?'}{' (bridge)' if info.bridge else ''}"
    way = "to" if info.dialled else "from"
    return linked.container, kind, f"{info.linked_s:.0f} s", str(info.calls), way, info.there, info.identity, info.here


def _network(info: NetworkInfo) -> Row:
    dials = [endpoint if linked else f"{endpoint} (no link)" for endpoint, linked in info.dials.items()]
    until = "-"
    if info.certificate_ends is not None:
        until = f"{datetime.fromtimestamp(info.certificate_ends, timezone.utc):%Y-%m-%d %H:%M} UTC"
    switches = ["on" if switch else "off" for switch in (info.discovery, info.broadcast)]
    return info.container, *switches, _list(info.listens), _list(dials), until, _list(info.bridge)


def _listener(info: ListenerInfo) -> Row:
    rate = f"{info.hz:g} Hz{', changes' if info.on_change else ''}"
    return info.service, info.session, rate, f"{info.left_s:.1f} s", info.container


def _at(event: StateEvent) -> float:
    return event.at


def _event(event: StateEvent) -> Row:
    return clock(event.at, ms=True), event.container, event.kind, event.about, event.text


def _list(texts: Sequence[str]) -> str:
    return ", ".join(texts) or "-"


_STATES: Final = {
    State.LINKS: _StateView(
        "network",
        ("CONTAINER", "LINKED WITH", "FOR", "CALLS", "DIALLED", "AT", "IDENTITY", "FROM"),
        _link,
        "no container is linked with another one",
    ),
    State.NETWORK: _StateView(
        "network",
        ("CONTAINER", "DISCOVERY", "BROADCAST", "LISTENS", "DIALS", "CERTIFICATE ENDS", "BRIDGE"),
        _network,
        "no container reports how it is reached",
    ),
    State.LISTENERS: _StateView(
        "stream_listeners",
        ("SERVICE", "LISTENER", "RATE", "UNTIL", "CONTAINER"),
        _listener,
        "no service is listened to",
    ),
    State.EVENTS: _StateView(
        "state_events",
        ("TIME", "CONTAINER", "EVENT", "ABOUT", "DETAILS"),
        _event,
        "no state has changed yet",
    ),
}
