"""Whom a container has found, and at which of the endpoints that it dials there is nobody."""

import time
from typing import Final

from msgspec import Struct

from trade._discovery.dialer import Dialer
from trade._protocol.keys import Address
from trade._registry.registry import Registry
from trade.errors import NobodyFound

__all__ = ["Reachability", "look_around"]

_LOOK_S: Final = 0.02
_HIDDEN: Final = (
    "there is a link, and nobody shows himself to {identity}; is its certificate revoked, does the policy there not "
    "know it, or is it another system than {system} there?"
)


class Reachability(Struct, frozen=True):
    """Whom a container has found so far."""

    others: tuple[str, ...]
    """The other containers (``identity/container``) that are there."""
    silent: tuple[str, ...] = ()
    """Those of them that have not said yet what is theirs."""
    apart: dict[str, str] = {}
    """The endpoints of ``Settings.connect`` where nobody was found, and why, as far as is known."""

    @property
    def unanswered(self) -> tuple[str, ...]:
        """The same in words, as errors tell it."""
        return tuple(f"{endpoint} (TRADE_CONNECT): {why}" for endpoint, why in self.apart.items())

    @property
    def complete(self) -> bool:
        """Whether somebody was found, at each endpoint, and all have said what is theirs."""
        return bool(self.others) and not self.silent and not self.apart

    def nobody(self, system: str, so: str = "") -> NobodyFound:
        """The error of who could not be told something.

        Args:
            system: where it was asked.
            so: what cannot be told therefore.
        """
        return NobodyFound(system=system, so=so, others=bool(self.others), silent=self.silent, apart=self.unanswered)


def look_around(registry: Registry, reach: Dialer | None, own: Address, system: str, limit_s: float) -> Reachability:
    """Wait until it is complete, for ``limit_s`` seconds at most; what it is then."""
    until = time.monotonic() + limit_s
    while not (found := _reachability(registry, reach, own)).complete and time.monotonic() < until:
        time.sleep(_LOOK_S)
    return found if reach is None else Reachability(found.others, found.silent, _apart(reach, own, system, found))


def _reachability(registry: Registry, reach: Dialer | None, own: Address) -> Reachability:
    states = [state for state in registry.containers() if state.address != own]
    unlinked = () if reach is None else reach.unlinked()
    return Reachability(
        others=tuple(state.address.who for state in states),
        silent=tuple(state.address.who for state in states if not state.heard.complete),
        apart=dict.fromkeys(unlinked, ""),
    )


def _apart(reach: Dialer, own: Address, system: str, found: Reachability) -> dict[str, str]:
    """Those without a link, and why; an endpoint may be linked by a link that leads from there to here."""
    reasons = {endpoint: reach.why_apart(endpoint, certain=not found.others) for endpoint in found.apart}
    apart = {endpoint: why for endpoint, why in reasons.items() if why}
    if not found.others:
        hidden = _HIDDEN.format(identity=own.identity, system=system)
        apart |= {endpoint: hidden for endpoint in reach.configured if endpoint not in apart}
    return apart
