"""Questions to all containers: each of them has the middleware's own services."""

import logging
from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase
from typing import Final, NamedTuple

from trade._calls.batch import Outcome
from trade._calls.handle import CallHost, Handle
from trade._context.call_context import patience_s
from trade._registry.registry import ContainerState, Registry
from trade.errors import AccessDenied, ContainerLost, ServiceGone
from trade.protocol.keys import DOMAIN, PROVIDER, Address, ServiceKey
from trade.protocol.messages import PROTOCOL

_logger = logging.getLogger("trade")

_KNOWN_WITHIN_S: Final = 1.0


class Everywhere(NamedTuple):
    """One of the middleware's own services, in all containers that have it."""

    handles: list[Handle]
    silent: list[Address]
    """The present containers that have not listed their services yet."""


def everywhere(home: CallHost, registry: Registry, name: str, container: str = "*") -> Everywhere:
    """Finds one of the middleware's own services in all present containers.

    A container whose other services are known already gets a second to list this one, too.

    Args:
        home: the container that asks.
        registry: its registry.
        name: the service's name.
        container: which containers; ``*`` and ``?`` match anything.
    """

    found = Everywhere([], [])

    def whole() -> bool:
        found.handles.clear()
        found.silent.clear()
        for state in registry.containers():
            if fnmatchcase(state.address.container, container):
                record = registry.get(ServiceKey(state.address, DOMAIN, PROVIDER, name))
                if record is not None:
                    found.handles.append(Handle(home, record.key, record))
                elif _is_unknown(state):
                    found.silent.append(state.address)
        return not found.silent

    registry.wait_for(whole, patience_s(_KNOWN_WITHIN_S))
    return found


def _is_unknown(state: ContainerState) -> bool:
    """Whether a container has not said yet if it has the middleware's own services."""
    return state.protocol in (0, PROTOCOL) and PROVIDER not in state.providers and not state.heard.complete


def answers(name: str, outcomes: Iterable[Outcome], silent: Sequence[Address]) -> list[Outcome]:
    """The successful outcomes of a question. Containers that did not answer are named in the log.

    Raises:
        AccessDenied: one of the containers does not allow it.
    """
    found, missing = list[Outcome](), {address.who: "it has not listed its services yet" for address in silent}
    for outcome in outcomes:
        if isinstance(outcome.error, AccessDenied):
            raise outcome.error
        if outcome.error is None:
            found.append(outcome)
        elif not isinstance(outcome.error, ContainerLost | ServiceGone):  # it has not left meanwhile
            missing[outcome.handle.key.address.who] = str(outcome.error)
    if missing:
        who = "; ".join(f"{one}: {why}" for one, why in missing.items())
        _logger.warning("%s: the answer is incomplete, as these containers did not answer: %s", name, who)
    return found
