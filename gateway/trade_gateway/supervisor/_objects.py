"""Creates the objects of a child's table with their saved state, and saves it."""

import re
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

from trade import Container, Handle, where
from trade.errors import CannotInstantiate, ConfigurationError, NoSuchService, ServiceGone, TradeError
from trade.starting import Started
from trade_gateway.config._children import Child
from trade_gateway.config._entry import ContainerSpec, ObjectSpec

GROUP: Final = "trade"
_LOOK_EVERY_S: Final = 0.02


def function_of(member: Container, container: str, name: str, *, epoch: str, wait_s: float) -> Handle:
    """Waits for a function of one boot of a container. Raises NoSuchService."""
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
    """Returns the objects of the file that a container does not offer."""
    if not part.entry.providers:
        return []
    found = member.services(where(container=part.name))
    offered = {(kind, frozenset(handle.groups)) for handle in found for kind in handle.kinds}
    return [
        one for one in part.entry.providers if (re.split(r"[.:]", one.class_)[-1], frozenset(one.groups)) not in offered
    ]


def make(instantiate: Handle, made: ObjectSpec, *, wait_s: float, state: Any = None) -> tuple[Handle, ...]:
    """Creates an object in a container; returns handles of its services. Raises what ``instantiate`` raises."""
    args = made.args if isinstance(made.args, Mapping) else tuple(made.args)
    wanted = (made.class_, args, tuple(made.groups))
    ask = instantiate.with_(deadline_s=wait_s)
    return ask(*wanted) if state is None else ask(*wanted, state)


def name_of(made: ObjectSpec, known: Mapping[str, object]) -> str:
    """Returns a name for an object, unique in its container and the same after a restart."""
    name = " ".join((made.class_, *made.groups))
    return next(one for one in (name, *(f"{name} #{n}" for n in range(2, len(known) + 3))) if one not in known)


_SEEN_S: Final = 15.0
_MADE_S: Final = 30.0


class CreatedObjects(NamedTuple):
    """A child with all objects of its table."""

    clock: Handle | None
    """The service for health checks; None: a program without one."""
    made: dict[str, Handle]
    """A service of each object that may have a state, by object name."""
    problems: list[str]


def furnish(
    member: Callable[[], Container], child: Child, started: Started, states: Mapping[str, Any]
) -> CreatedObjects:
    """Waits until a child is visible, and creates its objects; each has its state before the first call.

    Args:
        member: returns the calling container; if it changes meanwhile, the new one continues.
        child: the child.
        started: its process.
        states: the states by object name.

    Raises:
        TradeError: the child is not visible, or an object cannot be created or is wrongly pinned to this host (S20).
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
    problem = f"{child.name} was not visible within {_SEEN_S:g} s; check its certificate, its policy and its connect"
    raise ConfigurationError(where=f"container.{child.name}", problem=problem)


def _made(instantiate: Handle, one: ObjectSpec, state: Any, problems: list[str]) -> tuple[Handle, ...]:
    if state is not None:
        try:
            return make(instantiate, one, wait_s=_MADE_S, state=state)
        except CannotInstantiate as refused:
            problems.append(f"{one.class_} starts without its saved state, which it refused: {refused.problem}")
    return make(instantiate, one, wait_s=_MADE_S)


def _refuse_pinned(one: ObjectSpec, services: tuple[Handle, ...]) -> None:
    drives = sorted({name for service in services for name in _pinned_by(service)})
    if drives:
        problem = f"it drives {', '.join(drives)} of this host; only a relocatable class can run on another host"
        raise ConfigurationError(where=one.class_, problem=problem)


def _pinned_by(service: Handle) -> tuple[str, ...]:
    """Returns the resources that pin a service to this host. Raises ServiceGone if it is not visible."""
    until, pause = time.monotonic() + _SEEN_S, threading.Event()
    while True:
        try:
            return () if service.meta.get("relocatable") else service.resources
        except ServiceGone:  # its announcement has not arrived yet
            if time.monotonic() > until:
                raise
        pause.wait(_LOOK_EVERY_S)


def save(member: Container, furnished: CreatedObjects) -> dict[str, Any]:
    """Returns the states of a child's objects by name, without objects that are in use, moving or absent.

    Objects without a state are not asked again.
    """
    states: dict[str, Any] = {}
    for name, service in list(furnished.made.items()):
        try:
            state = member.save_state(member.handle(service.key))
        except ConfigurationError:
            del furnished.made[name]
        except Exception:  # noqa: BLE001, S112 - save_state raises the object's own types; the earlier state stays
            continue
        else:
            if state is not None:
                states[name] = state
    return states
