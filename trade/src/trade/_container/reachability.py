"""Reachability: the containers that one has found, and the dialled endpoints at which it found none."""

import time
from typing import Final

from msgspec import Struct, structs

from trade._discovery.dialer import Dialer
from trade._protocol.keys import Address
from trade._registry.registry import Registry
from trade.errors import NoContainerFound

__all__ = ["Reachability", "look_around"]

_LOOK_S: Final = 0.02
_HIDDEN: Final = (
    "the link is up, but no container is visible to {identity}. Is its certificate revoked, is it unknown to the "
    "policy there, or is the system there another one than {system}?"
)


class Reachability(Struct, frozen=True):
    """The containers that one has found so far."""

    others: tuple[str, ...]
    """The other present containers (``identity/container``). Those that list no services and, by the policy, may have
    none do not count."""
    silent: tuple[str, ...] = ()
    """Those of them that have not listed their services yet."""
    apart: dict[str, str] = {}
    """The endpoints of ``Settings.connect``, or of the hub, where no container was found; with reasons, if known."""
    source: str = "TRADE_CONNECT"
    """Where these endpoints are from."""

    @property
    def unanswered(self) -> tuple[str, ...]:
        """These endpoints and reasons, as text for errors."""
        return tuple(f"{endpoint} ({self.source}): {why}" for endpoint, why in self.apart.items())

    @property
    def complete(self) -> bool:
        """Whether it found a container at each endpoint, and all have listed their services."""
        return bool(self.others) and not self.silent and not self.apart

    def as_error(self, system: str, so: str = "") -> NoContainerFound:
        """The error of a request that has no reliable answer, because containers are missing.

        Args:
            system: the system of the request.
            so: what is unknown therefore.
        """
        others, apart = bool(self.others), self.unanswered
        return NoContainerFound(system=system, so=so, others=others, silent=self.silent, apart=apart)


def look_around(registry: Registry, reach: Dialer | None, own: Address, system: str, limit_s: float) -> Reachability:
    """Waits until it is complete, at most ``limit_s`` seconds, and returns it."""
    until = time.monotonic() + limit_s
    while not (found := _reachability(registry, reach, own)).complete and time.monotonic() < until:
        time.sleep(_LOOK_S)
    return found if reach is None else structs.replace(found, apart=_apart(reach, own, system, found))


def _reachability(registry: Registry, reach: Dialer | None, own: Address) -> Reachability:
    states = [state for state in registry.containers() if state.address != own and registry.counts(state)]
    unlinked = () if reach is None else reach.unlinked()
    return Reachability(
        others=tuple(state.address.who for state in states),
        silent=tuple(state.address.who for state in states if not state.heard.complete),
        apart=dict.fromkeys(unlinked, ""),
        source="" if reach is None else reach.source,
    )


def _apart(reach: Dialer, own: Address, system: str, found: Reachability) -> dict[str, str]:
    """The endpoints without a link, and why; a link from there to here counts, too."""
    reasons = {endpoint: reach.why_apart(endpoint, certain=not found.others) for endpoint in found.apart}
    apart = {endpoint: why for endpoint, why in reasons.items() if why}
    if not found.others:
        hidden = _HIDDEN.format(identity=own.identity, system=system)
        apart |= {endpoint: hidden for endpoint in reach.configured if endpoint not in apart}
    return apart
