"""What another system sees of a container, and what the container offers of it."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from msgspec import structs

from trade._calls.handle import Handle
from trade._container.proxy import Speaking, passed_on_service
from trade._locks.remote_locks import SharedResource
from trade._protocol.codec import Codec
from trade._protocol.keys import DOMAIN, Address, ServiceKey
from trade._protocol.messages import ProviderInfo, ServiceInfo
from trade._registry.registry import Registry
from trade._resources.lock_table import LockTable
from trade._resources.resource import Resource
from trade._services.event_loop import AsyncLoop
from trade._services.local_service import LocalService
from trade._services.providers import Providers
from trade.errors import ConfigurationError, SessionEnded

_PATIENCE_S = 1.0
"""How long a call that came before its caller's sign of life waits for that."""


class Exposed(NamedTuple):
    """Where a provider is."""

    address: Address
    domain: str
    provider: str

    def service(self, name: str) -> ServiceKey:
        """One of its services."""
        return ServiceKey(self.address, self.domain, self.provider, name)


class MemberSystem(NamedTuple):
    """How what is at home in another system is reached there."""

    place: Exposed
    handle: Callable[[ServiceKey], Handle]
    speaking: Speaking
    codec: Codec
    adopt: Callable[[str, str], SharedResource]
    """The resource of a name here that has another one there."""


class Federating:
    """Offers what is at home elsewhere, and shows what is at home here; ``container.federating``."""

    def __init__(
        self, address: Address, registry: Registry, providers: Providers, locks: LockTable, event_loop: AsyncLoop
    ) -> None:
        self._address = address
        self._registry = registry
        self._providers = providers
        self._locks = locks
        self._event_loop = event_loop

    # --- showing

    def offers(self) -> dict[Exposed, ProviderInfo]:
        """Every provider of the system that may offer what it does, the middleware's own left out."""
        return {
            Exposed(state.address, entry.domain, name): entry.info
            for state in self._registry.containers()
            for name, entry in list(state.providers.items())
            if entry.records and entry.domain != DOMAIN
        }

    def require_present(self, session: str) -> None:
        """Raises SessionEnded: its container is not there, or it has ended."""
        address = Address(*session.split("/")[:3])
        there = self._registry.wait_for(lambda: self._registry.is_alive(address), _PATIENCE_S)
        if (ended := self._locks.gone((session,))) is not None:
            raise ended
        if not there:
            raise SessionEnded(session=session, reason="nobody of that name is here")

    # --- offering

    def pass_on(self, provider: object, info: ProviderInfo, home: MemberSystem) -> Exposed:
        """Offer what is at home elsewhere.

        Args:
            provider: an object that stands for it here.
            info: what is told of it here.
            home: how it is reached.

        Raises:
            ConfigurationError: a resource of it has the name of another one here.
            AccessDenied: the policy does not let this container offer that.
        """

        def make(place: str) -> dict[str, LocalService]:
            adopted: list[Resource] = []
            try:
                return {one.name: self._passed_on(place, one, info, home, adopted) for one in info.services}
            except ValueError as twice:
                for one in adopted:
                    self._locks.drop(one)
                raise ConfigurationError(where=place, problem=str(twice)) from None

        return Exposed(self._address, *self._providers.pass_on(provider, info, make))

    def _passed_on(
        self, place: str, service: ServiceInfo, info: ProviderInfo, home: MemberSystem, adopted: list[Resource]
    ) -> LocalService:
        label = f"{info.groups[0] if info.groups else info.kind}.{service.name}"
        handle, first = home.handle(home.place.service(service.name)), len(adopted)
        for here, there in _lockable(place, service, home.place).items():
            adopted.append(self._locks.adopt(home.adopt(here, there)))
        resources = tuple(adopted[first:])
        return passed_on_service(label, service, handle, home.speaking, home.codec, resources, self._event_loop)

    def tell_anew(self, provider: object, info: ProviderInfo) -> None:
        """Tell something else about what is passed on; its services are the same."""
        self._providers.alter(provider, lambda known: structs.replace(info, revision=known.revision))

    def withdraw(self, provider: object) -> None:
        """Pass it on no more. Raises ConfigurationError: it was withdrawn already."""
        self._providers.remove(provider)


def _lockable(place: str, service: ServiceInfo, home: Exposed) -> dict[str, str]:
    """What locks of a service are about, here and at home. A stop has nothing: it is passed on, and judged there."""
    if service.effect == "stop":
        return {}
    uses = {name: name for name in service.uses} if service.effect != "read" else {}
    return uses or {f"{place}/{service.name}": f"{home.domain}/{home.provider}/{service.name}"}


def shown(info: ProviderInfo, groups: Sequence[str]) -> tuple[str, ...]:
    """Those of a provider's groups that lie in some others."""
    return tuple(group for group in info.groups if inside(group, groups))


def inside(group: str, groups: Sequence[str]) -> bool:
    """Whether a group is one of these or beneath one; ``*`` is all."""
    return any(whole == "*" or group == whole or group.startswith(f"{whole}.") for whole in groups)
