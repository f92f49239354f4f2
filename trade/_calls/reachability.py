"""Reachability: the containers that one has found, and the dialled endpoints at which it found none."""

import time
from collections.abc import Callable
from typing import Final

from msgspec import Struct, structs

from trade._calls import batch
from trade._calls.handle import Handle
from trade._discovery.dialer import Dialer
from trade._registry.constraints import where
from trade._registry.registry import Registry
from trade.errors import NoContainerFound
from trade.protocol.container_info import ContainerInfo
from trade.protocol.keys import DOMAIN, Address, ServiceKey

_LOOK_S: Final = 0.02
_ASK_S: Final = 0.5
_MOST_ASKED: Final = 16
"""Where more are known, a question to each would cost more than what one of them may see."""
_OWN_PROVIDERS: Final = 2
"""What every container has: one with no more is a client, which comes and goes."""
_HIDDEN: Final = (
    "the link is up, but no container is visible to {identity}. Is its certificate revoked, is it unknown to the "
    "policy there, or is the system there another one than {system}?"
)


class Reachability(Struct, frozen=True, rename={"unreached": "apart"}):
    """The containers that one has found so far."""

    others: tuple[str, ...]
    """The other present containers (``identity/container``). Those that list no services and, by the policy, may have
    none do not count."""
    silent: tuple[str, ...] = ()
    """Those of them that have not listed their services yet."""
    unreached: dict[str, str] = {}
    """The endpoints of ``Settings.connect``, or of the hub, where no container was found; with reasons, if known."""
    source: str = "TRADE_CONNECT"
    """Where these endpoints are from."""

    @property
    def unanswered(self) -> tuple[str, ...]:
        """These endpoints and reasons, as text for errors."""
        return tuple(f"{endpoint} ({self.source}): {why}" for endpoint, why in self.unreached.items())

    @property
    def complete(self) -> bool:
        """Whether it found a container at each endpoint, and all have listed their services."""
        return bool(self.others) and not self.silent and not self.unreached

    def as_error(self, system: str, so: str = "") -> NoContainerFound:
        """The error of a request that has no reliable answer, because containers are missing.

        Args:
            system: the system of the request.
            so: what is unknown therefore.
        """
        others, unreached = bool(self.others), self.unanswered
        return NoContainerFound(system=system, so=so, others=others, silent=self.silent, apart=unreached)


def look_around(registry: Registry, reach: Dialer | None, own: Address, system: str, limit_s: float) -> Reachability:
    """Waits until it is complete, at most ``limit_s`` seconds, and returns it."""
    until = time.monotonic() + limit_s
    while not (found := _reachability(registry, reach, own)).complete and time.monotonic() < until:
        time.sleep(_LOOK_S)
    return found if reach is None else structs.replace(found, unreached=_unreached(reach, own, system, found))


def _reachability(registry: Registry, reach: Dialer | None, own: Address) -> Reachability:
    states = [state for state in registry.containers() if state.address != own and registry.counts(state)]
    unlinked = () if reach is None else reach.unlinked()
    return Reachability(
        others=tuple(state.address.who for state in states),
        silent=tuple(state.address.who for state in states if not state.heard.complete),
        unreached=dict.fromkeys(unlinked, ""),
        source="" if reach is None else reach.source,
    )


def _unreached(reach: Dialer, own: Address, system: str, found: Reachability) -> dict[str, str]:
    """The endpoints without a link, and why; a link from there to here counts, too."""
    reach.try_all(list(found.unreached))
    reasons = {endpoint: reach.why_apart(endpoint, certain=not found.others) for endpoint in found.unreached}
    unreached = {endpoint: why for endpoint, why in reasons.items() if why}
    if not found.others:
        hidden = _HIDDEN.format(identity=own.identity, system=system)
        unreached |= {endpoint: hidden for endpoint in reach.configured if endpoint not in unreached}
    return unreached


def beyond(
    registry: Registry, reach: Dialer | None, handle: Callable[[ServiceKey], Handle], wait_s: float = 0.0
) -> list[str]:
    """What other containers see and this one does not, as sentences with the addresses that were tried in vain.

    For example: "base sees rosie (12 services); no link from here yet: tried 10.9.0.5:7450 (refused)".

    Args:
        registry: of this container.
        reach: its links.
        handle: a handle of a service.
        wait_s: how long to wait until it sees them, too, in seconds.
    """
    lists = registry.select(where(name="containers", group=DOMAIN))
    others = [record for record in lists if not record.local][:_MOST_ASKED]
    asked = [handle(record.key).with_(deadline_s=_ASK_S) for record in others]
    seen: dict[str, tuple[ContainerInfo, list[str]]] = {}
    for outcome in batch.all_outcomes([one.bind() for one in asked]):
        for info in outcome.result if outcome.ok else ():
            if info.providers > _OWN_PROVIDERS:
                seen.setdefault(info.epoch, (info, []))[1].append(outcome.handle.container)

    def missing() -> list[str]:
        present = {state.address.epoch for state in registry.containers()}
        return [epoch for epoch in seen if epoch not in present]

    registry.wait_for(lambda: not missing(), wait_s)
    vain = [] if reach is None else [str(attempt) for attempt in reach.attempts() if attempt.problem]
    tried = f": tried {', '.join(vain)}" if vain else ""
    found = [(", ".join(sorted(seen[epoch][1])), seen[epoch][0]) for epoch in missing()]
    return [f"{by} sees {one.name} ({one.services} services); no link from here yet{tried}" for by, one in found]
