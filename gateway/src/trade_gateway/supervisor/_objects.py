"""The objects that a child's table names: made with their state once its process is up, and saved."""

import re
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

from trade import Container, Handle, where
from trade.errors import CannotInstantiate, ConfigurationError, NoSuchService, ServiceGone, TradeError
from trade.starting import Started
from trade_gateway.config._children import Child
from trade_gateway.config._tables import ContainerSpec, ObjectSpec

__all__ = ["GROUP", "CreatedObjects", "function_of", "furnish", "lacking", "make", "name_of", "save"]

GROUP: Final = "trade"
_LOOK_EVERY_S: Final = 0.02


def function_of(member: Container, container: str, name: str, *, epoch: str, wait_s: float) -> Handle:
    """A function of one boot of a container, as soon as it is seen. Raises NoSuchService."""
    wanted, until, pause = (
        where(name=name, group=GROUP, container=container),
        time.monotonic() + wait_s,
        threading.Event(),
    )
    while True:
        for found in member.services(wanted):
            if found.key.address.epoch == epoch:
                return found
        if time.monotonic() > until:
            raise NoSuchService(constraint=str(wanted))
        pause.wait(_LOOK_EVERY_S)


def lacking(member: Container, part: ContainerSpec) -> list[ObjectSpec]:
    """What the file wants made in a container, and it does not offer."""
    if not part.entry.providers:
        return []
    found = member.services(where(container=part.name))
    offered = {(kind, frozenset(handle.groups)) for handle in found for kind in handle.kinds}
    return [
        one for one in part.entry.providers if (re.split(r"[.:]", one.class_)[-1], frozenset(one.groups)) not in offered
    ]


def make(instantiate: Handle, made: ObjectSpec, *, wait_s: float, state: Any = None) -> tuple[Handle, ...]:
    """Have an object made; handles of its services. Raises what ``instantiate`` does."""
    args = made.args if isinstance(made.args, Mapping) else tuple(made.args)
    told = (made.class_, args, tuple(made.groups))
    ask = instantiate.with_(deadline_s=wait_s)
    return ask(*told) if state is None else ask(*told, state)


def name_of(made: ObjectSpec, known: Mapping[str, object]) -> str:
    """A name for an object that no other one of the same container has, and the next one in its place has, too."""
    name = " ".join((made.class_, *made.groups))
    return next(one for one in (name, *(f"{name} #{n}" for n in range(2, len(known) + 3))) if one not in known)


_SEEN_S: Final = 15.0
_MADE_S: Final = 30.0


class CreatedObjects(NamedTuple):
    """A child that has all that its table names."""

    clock: Handle
    """What it is asked for, to see whether it answers."""
    made: dict[str, Handle]
    """A service of each object that may have a state, by the object's name."""
    problems: list[str]


def furnish(
    member: Callable[[], Container], child: Child, started: Started, states: Mapping[str, Any]
) -> CreatedObjects:
    """Wait until a child is seen, and make its objects; each has its state before anybody can call it.

    Args:
        member: the container that asks; if it is another one meanwhile, that one goes on.
        child: which.
        started: its process.
        states: by the names of its objects.

    Raises:
        TradeError: it is not seen, or an object cannot be made, or is pinned to this host and must not be (S20).
    """
    made: dict[str, Handle] = {}
    problems: list[str] = []
    clock = _function(member, child, started, "clock")
    for one in child.part.entry.providers or ():
        name = name_of(one, made)
        instantiate = _function(member, child, started, "instantiate")
        services = _made(instantiate, one, states.get(name), problems)
        if any(child.lease):
            _refuse_pinned(one, services)
        made[name] = services[0]
    return CreatedObjects(clock, made, problems)


def _function(member: Callable[[], Container], child: Child, started: Started, name: str) -> Handle:
    asked = member()
    try:
        return function_of(asked, child.name, name, epoch=started.epoch, wait_s=_SEEN_S)
    except TradeError as unseen:
        if member() is not asked:
            return _function(member, child, started, name)
        if not isinstance(unseen, NoSuchService):
            raise
    problem = (
        f"{child.name} is not seen within {_SEEN_S:g} s; does its certificate, its policy or its connect let it in?"
    )
    raise ConfigurationError(where=f"container.{child.name}", problem=problem)


def _made(instantiate: Handle, one: ObjectSpec, state: Any, problems: list[str]) -> tuple[Handle, ...]:
    if state is not None:
        try:
            return make(instantiate, one, wait_s=_MADE_S, state=state)
        except CannotInstantiate as refused:
            problems.append(f"{one.class_} begins anew, as it does not take its state: {refused.problem}")
    return make(instantiate, one, wait_s=_MADE_S)


def _refuse_pinned(one: ObjectSpec, services: tuple[Handle, ...]) -> None:
    drives = sorted({name for service in services for name in _pinned_by(service)})
    if drives:
        problem = f"it drives {', '.join(drives)} of this host; only a class that is relocatable can be back elsewhere"
        raise ConfigurationError(where=one.class_, problem=problem)


def _pinned_by(service: Handle) -> tuple[str, ...]:
    """What it drives that its class does not say can be reached from elsewhere. Raises ServiceGone: it is not seen."""
    until, pause = time.monotonic() + _SEEN_S, threading.Event()
    while True:
        try:
            return () if service.meta.get("relocatable") else service.resources
        except ServiceGone:  # it is called before it is heard of
            if time.monotonic() > until:
                raise
        pause.wait(_LOOK_EVERY_S)


def save(member: Container, furnished: CreatedObjects) -> dict[str, Any]:
    """The states of a child's objects, by name; without those that are in use, moving or not there.

    What has no state is not asked again.
    """
    states: dict[str, Any] = {}
    for name, service in list(furnished.made.items()):
        try:
            state = member.save_state(member.handle(service.key))
        except ConfigurationError:
            del furnished.made[name]
        except Exception:  # noqa: BLE001, S112 - what save_state raises comes as its own type; the state of before stays
            continue
        else:
            if state is not None:
                states[name] = state
    return states
