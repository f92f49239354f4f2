"""Federation, a container's side: it lists its system's providers, and offers those of another system."""

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

from msgspec import structs

from trade._calls.client import CallClient
from trade._calls.handle import Handle
from trade._estop.controller import EstopController
from trade._federation.proxy import Speaking, passed_on_service
from trade._locks.lease_client import LeaseClient
from trade._locks.remote_locks import RemoteLocks, SharedResource
from trade._resources.lock_table import LockTable
from trade._resources.resource import Resource
from trade._services.event_loop import AsyncLoop
from trade._services.local_service import LocalService
from trade._services.providers import Providers
from trade.errors import ConfigurationError, SessionEnded
from trade.protocol.codec import Codec
from trade.protocol.keys import DOMAIN, Address, ServiceKey
from trade.protocol.messages import ProviderInfo, ServiceInfo

_PATIENCE_S = 1.0
"""How long a call that arrives before its caller's liveliness token waits for it."""


class ProviderPlace(NamedTuple):
    """The place of a provider."""

    address: Address
    domain: str
    provider: str

    def service(self, name: str) -> ServiceKey:
        """One of its services."""
        return ServiceKey(self.address, self.domain, self.provider, name)


class MemberSystem(NamedTuple):
    """Access to a provider in its home system."""

    place: ProviderPlace
    handle: Callable[[ServiceKey], Handle]
    speaking: Speaking
    codec: Codec
    adopt: Callable[[str, str], SharedResource]
    """Returns the resource of a name here for a name there."""


class Federation:
    """Offers providers of another system, and lists those of this one; ``container.federation``.

    Args:
        client: of the container.
        providers: what the container offers.
        locks: of its resources.
        remote_locks: the locks in other systems behind its grants.
        lease_client: renews its own locks.
        estop: its e-stops.
        event_loop: of its coroutine functions.
    """

    def __init__(
        self,
        client: CallClient,
        providers: Providers,
        locks: LockTable,
        remote_locks: RemoteLocks,
        lease_client: LeaseClient,
        estop: EstopController,
        event_loop: AsyncLoop,
    ) -> None:
        self._address = client.address
        self._registry = client.registry
        self._providers = providers
        self._locks = locks
        self.remote_locks: Final = remote_locks
        self.lease_client: Final = lease_client
        self.estop: Final = estop
        self._event_loop = event_loop

    # --- showing

    def offers(self) -> dict[ProviderPlace, ProviderInfo]:
        """All providers of the system that the policy allows, without the middleware's own."""
        return {
            ProviderPlace(state.address, entry.domain, name): entry.info
            for state in self._registry.containers()
            for name, entry in state.providers.copy().items()
            if entry.records and entry.domain != DOMAIN
        }

    def require_present(self, session: str) -> None:
        """Raises SessionEnded if the session has ended or its container is not present."""
        address = Address(*session.split("/")[:3])
        there = self._registry.wait_for(lambda: self._registry.is_alive(address), _PATIENCE_S)
        if (ended := self._locks.session_error((session,))) is not None:
            raise ended
        if not there:
            raise SessionEnded(session=session, reason="its container is not in this system")

    # --- offering

    def pass_on(self, provider: object, info: ProviderInfo, home: MemberSystem) -> ProviderPlace:
        """Offers a provider of another system.

        Args:
            provider: an object that represents it here.
            info: its description here.
            home: the access to it.

        Raises:
            ConfigurationError: one of its resources has the name of another one here.
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

        return ProviderPlace(self._address, *self._providers.pass_on(provider, info, make))

    def _passed_on(
        self, place: str, service: ServiceInfo, info: ProviderInfo, home: MemberSystem, adopted: list[Resource]
    ) -> LocalService:
        label = f"{info.groups[0] if info.groups else info.kind}.{service.name}"
        handle, first = home.handle(home.place.service(service.name)), len(adopted)
        for here, there in _lockable(place, service, home.place).items():
            adopted.append(self._locks.adopt(home.adopt(here, there)))
        resources = tuple(adopted[first:])
        return passed_on_service(label, service, handle, home.speaking, home.codec, resources, self._event_loop)

    def update(self, provider: object, info: ProviderInfo) -> None:
        """Replaces the description of a forwarded provider; its services are the same."""
        self._providers.alter(provider, lambda known: structs.replace(info, revision=known.revision))

    def withdraw(self, provider: object) -> None:
        """Withdraws a forwarded provider. Raises ConfigurationError if it was withdrawn already."""
        self._providers.remove(provider)


def _lockable(place: str, service: ServiceInfo, home: ProviderPlace) -> dict[str, str]:
    """The resources that locks of a service hold, by the names here and at home; a stop has none."""
    if service.effect == "stop":
        return {}
    uses = {name: name for name in service.uses} if service.effect != "read" else {}
    return uses or {f"{place}/{service.name}": f"{home.domain}/{home.provider}/{service.name}"}


def shown(info: ProviderInfo, groups: Sequence[str]) -> tuple[str, ...]:
    """The groups of a provider that are inside other groups."""
    return tuple(group for group in info.groups if inside(group, groups))


def inside(group: str, groups: Sequence[str]) -> bool:
    """Whether a group is one of these or beneath one; ``*`` includes all."""
    return any(whole == "*" or group == whole or group.startswith(f"{whole}.") for whole in groups)
