"""What a table wants in a container: waiting until the container is seen, making the objects it lacks."""

import re
import threading
import time
from collections.abc import Mapping
from typing import Any, Final

from trade import Container, Handle, where
from trade.errors import NoSuchService
from trade_gateway.config._tables import ContainerSpec, ObjectSpec

__all__ = ["GROUP", "function_of", "lacking", "make", "name_of"]

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
