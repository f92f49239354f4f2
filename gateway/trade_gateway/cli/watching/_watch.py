"""``trade watch``: prints the events of a system: services, health, locks, e-stops."""

import queue
import threading
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from functools import partial
from typing import Annotated, Final, Literal, NamedTuple, TypeVar

import typer
from msgspec import Struct
from rich.markup import escape

from trade import Constraint, Container, Estop, Handle, LockInfo, where
from trade.errors import TradeError
from trade.protocol.messages import HEALTHY
from trade.timestamps import clock
from trade_gateway._usage import asked_for
from trade_gateway.terminal._options import Json
from trade_gateway.terminal._output import Output
from trade_gateway.terminal._system_choice import visitor

_EVERY_S: Final = 0.3
"""Events of one container within this time share a line."""
_ASKED_EVERY_S: Final = 1.0
"""How often every container is asked for its locks, in seconds."""
_NAMED: Final = 3
_COLOURS: Final = {"is well": "green", "is not well": "bold red", "e-stop": "bold red", "cleared": "green"}

_Key = TypeVar("_Key")
_Value = TypeVar("_Value")
What = Literal["came", "went", "changed", "is well", "is not well", "locked", "released", "e-stop", "cleared"]


class Event(Struct, frozen=True):
    """A change in the system; with ``--json`` one line."""

    at: float
    """``time.time()`` here."""
    what: What
    about: str
    """A service, resources, or an e-stop's id."""
    container: str = ""
    text: str = ""
    """The problem, the lock's owner and purpose, or the e-stop's giver and reason."""


class _EventKind(NamedTuple):
    """Events of one kind, which share a line."""

    what: What
    container: str
    text: str


def watch(
    context: typer.Context,
    group: Annotated[str | None, typer.Option(help="Watch only this group and those beneath it: rosie.head.")] = None,
    everything: Annotated[bool, typer.Option("--all", help="Also watch the middleware's own services.")] = False,
    as_json: Json = False,
) -> None:
    """Print changes of services, locks and e-stops until Ctrl-C.

    Locks and e-stops are polled every second, so shorter ones may be missed. With --json, each line is an object.

    For example: trade watch --group rosie
    """
    meant = asked_for(f"--group {group}" if group else "watch", group=group, name=None)
    if not everything and group is None:
        meant = meant & ~where(group="trade")
    out = Output(as_json=as_json)
    with visitor(context) as container:
        seen = WatchedSystem(container, meant)
        out.say(f"watching {seen.services} services in system {escape(container.settings.system)}; Ctrl-C ends")
        pause = threading.Event()
        while True:
            _say(out, list(seen.news()))
            pause.wait(_EVERY_S)


class WatchedSystem:
    """The known state of a system, and its changes."""

    def __init__(self, container: Container, meant: Constraint) -> None:
        self._container = container
        self._events: queue.SimpleQueue[tuple[What, Handle]] = queue.SimpleQueue()
        here = meant & ~where.local
        container.joined(here, partial(self._put, "came"))
        container.left(here, partial(self._put, "went"))
        container.changed(here, partial(self._put, "changed"))
        known = container.services(here)
        self.services: Final = len(known)
        """The number of services at the start."""
        self._health = {handle.key: handle.health for handle in known if handle.health != HEALTHY}
        self._meant = meant
        self._locks: dict[tuple[str, str], LockInfo] = {}
        self._estops: dict[str, Estop] = {}
        self._asked_at = -_ASKED_EVERY_S

    def _put(self, what: What, handle: Handle) -> None:
        self._events.put((what, handle))

    def news(self) -> Iterator[Event]:
        """Returns the events since the last call; the first includes existing locks and e-stops."""
        now = time.time()
        with suppress(queue.Empty):
            while True:
                yield self._of_service(now, *self._events.get_nowait())
        if time.monotonic() - self._asked_at >= _ASKED_EVERY_S:
            self._asked_at = time.monotonic()
            with suppress(TradeError):  # a container shuts down or refuses; the next poll will show
                yield from self._of_locks(now)
            yield from self._of_estops(now)

    def _of_service(self, at: float, what: What, handle: Handle) -> Event:
        before = self._health.pop(handle.key, HEALTHY)
        if what == "went":
            return Event(at, what, handle.label, handle.container)
        health = handle.health
        if health != HEALTHY:
            self._health[handle.key] = health
        if health == before:
            return Event(at, what, handle.label, handle.container)
        well = health == HEALTHY
        return Event(at, "is well" if well else "is not well", handle.label, handle.container, "" if well else health)

    def _of_locks(self, at: float) -> Iterator[Event]:
        uses = {use for handle in self._container.services(self._meant) for use in handle.resources}
        known = self._container.lock_api.known()
        found = {(", ".join(info.resources), info.holder.owner): info for info in known.locks}
        found = {key: info for key, info in found.items() if not uses.isdisjoint(info.resources)}
        found |= {key: info for key, info in self._locks.items() if known.still(info.container)}
        for info in _new(self._locks, found):
            yield _of_lock(at, "released", info)
        for info in _new(found, self._locks):
            yield _of_lock(at, "locked", info)
        self._locks = found

    def _of_estops(self, at: float) -> Iterator[Event]:
        found = {known.id: known for known in self._container.estops()}
        for known in _new(self._estops, found):
            yield _of_estop(at, "cleared", known)
        for known in _new(found, self._estops):
            yield _of_estop(at, "e-stop", known)
        self._estops = found


def _of_lock(at: float, what: What, info: LockInfo) -> Event:
    purpose = f" ({info.holder.purpose})" if info.holder.purpose else ""
    return Event(at, what, ", ".join(info.resources), info.container, info.holder.owner + purpose)


def _of_estop(at: float, what: What, known: Estop) -> Event:
    return Event(at, what, known.id, "", f"{known.giver}: {known.reason}" if known.reason else known.giver)


def _say(out: Output, news: Iterable[Event]) -> None:
    kinds: dict[_EventKind, list[Event]] = {}
    for one in news:
        if out.as_json:
            out.data(one)
        kinds.setdefault(_EventKind(one.what, one.container, one.text), []).append(one)
    for kind, alike in kinds.items():
        colour = _COLOURS.get(kind.what, "bold")
        about = escape(_some([one.about for one in alike]))
        detail = f": {escape(kind.text)}" if kind.text else ""
        out.say(
            f"{clock(alike[0].at, ms=True)} {escape(kind.container):12} [{colour}]{kind.what:11}[/] {about}{detail}"
        )


def _some(names: list[str]) -> str:
    shown = names if len(names) <= _NAMED + 1 else names[:_NAMED]
    more = f" and {len(names) - len(shown)} more" if len(names) > len(shown) else ""
    return ", ".join(shown) + more


def _new(now: Mapping[_Key, _Value], before: Mapping[_Key, object]) -> list[_Value]:
    """Returns the values with new keys."""
    return [value for key, value in now.items() if key not in before]
