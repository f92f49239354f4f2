"""The source of a migration: the provider is held still, prepared elsewhere, withdrawn here, and offered there.

It is withdrawn here before it is offered there, so it is never active twice. Up to that moment any error leaves it as
it was. After it, this container offers it again only if the target says that it never will.
"""

import contextlib
import logging
import threading
from collections.abc import Generator, Mapping
from typing import Any, Final

from trade._calls.client import CallClient
from trade._calls.handle import Handle
from trade._context.call_context import running
from trade._migration.factory import Arguments, ProviderFactory, path_of
from trade._migration.quiesce import BlockedResources, Quiescer, is_stateful, restore, save
from trade._migration.target import Prepared, ProviderSnapshot, fingerprint
from trade._registry.constraints import where
from trade._security.authorizer import Authorizer
from trade._services.providers import Providers
from trade._services.registration import ProviderOffer
from trade._services.withdrawn import WithdrawnProviders
from trade._telemetry.load import busyness
from trade.errors import (
    CannotMigrate,
    ConfigurationError,
    ContainerLost,
    LockedByOther,
    MigrationUnknown,
    NoSuchService,
    OutcomeUnknown,
    ServiceGone,
    TradeError,
)
from trade.protocol.codec import Codec
from trade.protocol.keys import DOMAIN, PROVIDER, Address, ServiceKey

_logger = logging.getLogger("trade")
PREPARE: Final = "prepare_arrival"
_PREPARE_S: Final = 15.0
_ARRIVE_S: Final = 5.0
_ASK_S: Final = 2.0


class MigrationSource:
    """Moves providers of one container to other containers, and saves or restores their state."""

    def __init__(
        self,
        client: CallClient,
        providers: Providers,
        factory: ProviderFactory,
        withdrawn_providers: WithdrawnProviders,
        quiescer: Quiescer,
        access: Authorizer,
        codec: Codec,
    ) -> None:
        self._client = client
        self._providers = providers
        self._factory = factory
        self._withdrawn_providers = withdrawn_providers
        self._quiescer = quiescer
        self._access = access
        self._codec = codec
        self._lock = threading.Lock()
        self._frozen_places: set[str] = set()
        """Places of the providers that are being held still."""

    # --- state

    def save_state(self, service: Handle, caller: str) -> Any:
        """See `Container.save_state`."""
        offer = self._stateful(service, caller)
        with self._freeze(service, offer, f"saving the state of {service.label}"):
            return save(offer.provider)

    def restore_state(self, service: Handle, state: Any, caller: str) -> None:
        """See `Container.restore_state`."""
        offer = self._stateful(service, caller)
        with self._freeze(service, offer, f"restoring the state of {service.label}") as frozen:
            restore(offer.provider, state)
            frozen.check()

    def _stateful(self, service: Handle, caller: str) -> ProviderOffer:
        offer = self._offer(service, caller)
        if not is_stateful(type(offer.provider)):
            problem = "it has no state to save and restore; its class needs save_state() and restore_state(state)"
            raise ConfigurationError(where=service.label, problem=problem)
        return offer

    def _offer(self, service: Handle, caller: str) -> ProviderOffer:
        """The registration of a service's provider; raises ServiceGone, AccessDenied, ConfigurationError."""
        key = service.key
        if key.address != self._client.address:
            problem = f"it belongs to another container, or to an earlier boot; ask {key.address.container}"
            raise ConfigurationError(where=service.label, problem=problem)
        if key.domain == DOMAIN:
            raise ConfigurationError(where=service.label, problem="the middleware's own services stay where they are")
        self._providers.lookup(_place(key), key.name)
        offer = self._providers.offer(_place(key))
        if offer is None:
            raise ServiceGone(service=service.label)
        self._require(caller, key, offer)
        return offer

    def _require(self, caller: str, key: ServiceKey, offer: ProviderOffer) -> None:
        for group in dict.fromkeys((key.domain, *offer.groups)):
            self._access.require(caller, "administer", group, f"{type(offer.provider).__qualname__} in {group}")

    @contextlib.contextmanager
    def _freeze(self, service: Handle, offer: ProviderOffer, purpose: str) -> Generator[BlockedResources, None, None]:
        place = _place(service.key)
        with self._lock:
            if place in self._frozen_places:
                own = self._client.address
                owner = own.who
                raise LockedByOther(resources=(place,), owner=owner, purpose="moving it, or its state, already")
            self._frozen_places.add(place)
        try:
            services = self._providers.services_at(place)
            with self._quiescer.frozen(services, lambda: self._providers.alone_with(offer.provider), purpose) as frozen:
                yield frozen
        finally:
            with self._lock:
                self._frozen_places.discard(place)

    # --- migrating

    def migrate(self, service: Handle, to: str, args: Arguments | None, caller: str) -> list[Handle]:
        """See `Container.migrate`."""
        offer = self._offer(service, caller)
        self._require_free(service, offer)
        there = self._target(to)
        with self._freeze(service, offer, f"migrating to container {there.container}") as frozen:
            snapshot = self._packed(service, offer, there, args)
            prepared: Prepared = there.with_(deadline_s=_PREPARE_S)(snapshot)
            keys = _keys(there.key.address, prepared)
            try:
                self._require(caller, service.key, offer)  # again, as time has passed
                _require_time(service, there)
                frozen.check()
                frozen.seal()
                name = self._withdrawn_providers.take_off(service.key, moved_to=_moved_to(keys[0]))
            except BaseException:
                frozen.unseal()
                with contextlib.suppress(TradeError):  # else the ticket there expires
                    self._ask(there.key.address, "arrived", _ASK_S, prepared.ticket)
                raise
            free = running.set(None)  # the caller may be gone: the move is completed
            try:
                self._hand_over(service, offer, keys, prepared.ticket, name)
            finally:
                running.reset(free)
        return [self._client.handle(key) for key in keys]

    def _require_free(self, service: Handle, offer: ProviderOffer) -> None:
        """S20: hardware is bound to its host, unless its driver declares that other hosts can reach it."""
        uses = {name for one in self._providers.services_at(_place(service.key)).values() for name in one.info.uses}
        if uses and not getattr(offer.provider, "relocatable", False):
            problem = f"it drives {', '.join(sorted(uses))} of this host; only a class that is relocatable can leave"
            raise ConfigurationError(where=service.label, problem=problem)

    def _target(self, to: str) -> Handle:
        """`PREPARE` of the container of that name; of several matches, of the one whose host is least busy."""
        asked = where(name=PREPARE, group=DOMAIN, container=to)
        found = [one for one in self._client.services(asked) if one.key.address != self._client.address]
        if not found:
            raise NoSuchService(constraint=f"{asked}, other than {self._client.address.container} itself")
        return found[0] if len(found) == 1 else min(found, key=self._load)

    def _load(self, there: Handle) -> tuple[float, float]:
        try:
            return busyness(self._ask(there.key.address, "load", _ASK_S))
        except TradeError as error:
            _logger.info("container %s does not report its load: %s", there.container, error)
            return float("inf"), 0.0

    def _packed(self, service: Handle, offer: ProviderOffer, there: Handle, args: Arguments | None) -> ProviderSnapshot:
        kind, stateful = type(offer.provider), is_stateful(type(offer.provider))
        try:
            state = save(offer.provider) if stateful else None
        except Exception as error:
            problem = f"save_state: {type(error).__name__}: {error}"
            raise CannotMigrate(provider=service.label, to=there.container, problem=problem) from error
        given = self._factory.arguments_of(offer.provider) if args is None else args
        return ProviderSnapshot(
            class_path=path_of(kind),
            fingerprint=fingerprint(kind, offer.implements, self._codec),
            args=dict(given) if isinstance(given, Mapping) else tuple(given),
            groups=offer.groups,
            implements=tuple(path_of(one) for one in offer.implements),
            meta=dict(offer.meta),
            has_state=stateful,
            state=state,
        )

    def _hand_over(self, service: Handle, offer: ProviderOffer, keys: list[ServiceKey], ticket: str, name: str) -> None:
        """Offer the withdrawn provider there, or here again if it is certain that the target will not."""
        there, problem = keys[0].address, ""
        try:
            self._ask(there, "arrive", _ARRIVE_S, ticket)
        except (OutcomeUnknown, ContainerLost):
            try:
                if not self._is_offered(keys, ticket):
                    problem = "it was not offered there in time"
            except TradeError as error:
                here = self._client.address.container
                raise MigrationUnknown(
                    provider=service.label, container=here, to=there.container, withdrawn=name
                ) from error
        except TradeError as error:
            problem = error.problem if isinstance(error, CannotMigrate) else str(error)
        if problem:
            self._withdrawn_providers.put_back(name, None)
            raise CannotMigrate(provider=service.label, to=there.container, problem=problem, withdrawn=True)
        self._factory.release(offer.provider)

    def _is_offered(self, keys: list[ServiceKey], ticket: str) -> bool:
        """Whether the target offers it; if not, it never will. Raises TradeError if the target cannot be asked."""
        return self._client.has(keys[0]) or self._ask(keys[0].address, "arrived", _ASK_S, ticket)

    def _ask(self, there: Address, name: str, deadline_s: float, *args: object) -> Any:
        return self._client.handle(ServiceKey(there, DOMAIN, PROVIDER, name)).with_(deadline_s=deadline_s)(*args)


def _require_time(service: Handle, there: Handle) -> None:
    call = running.get()
    if call is not None and call.remaining_s == 0:
        problem = "the caller's deadline has passed"
        raise CannotMigrate(provider=service.label, to=there.container, problem=problem)


def _place(key: ServiceKey) -> str:
    return f"{key.domain}/{key.provider}"


def _keys(there: Address, prepared: Prepared) -> list[ServiceKey]:
    return [ServiceKey(there, prepared.domain, prepared.provider, name) for name in prepared.services]


def _moved_to(key: ServiceKey) -> str:
    return f"{key.address}/{_place(key)}"
