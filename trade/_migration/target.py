"""The target of a migration: creates the provider with its state, and offers it once the source withdrew it."""

import contextlib
import hashlib
import secrets
import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any, Final

from msgspec import Struct, structs

from trade._migration.factory import ProviderFactory, end, path_of
from trade._migration.quiesce import Quiescer, is_stateful, restore
from trade._security.authorizer import Authorizer
from trade._services.decorator import marked_methods
from trade._services.providers import Providers
from trade._services.registration import BuiltProvider, checked_groups
from trade._services.signature import Signature
from trade._threads.scheduler import ScheduledTask, Scheduler
from trade.errors import Busy, CannotInstantiate, CannotMigrate, LockedByOther, NoSuchClass
from trade.protocol.codec import Codec
from trade.protocol.keys import Address, ServiceKey, domain_of
from trade.protocol.messages import Scalar, encode_message
from trade.protocol.schema_types import imported

TICKET_S: Final = 20.0
"""A prepared provider that is not fetched within this time is closed again."""
MOST: Final = 8
"""The largest number of prepared providers."""
_REMEMBERED: Final = 256


class ProviderSnapshot(Struct, frozen=True, kw_only=True):
    """Everything needed to create the provider elsewhere and to offer it."""

    class_path: str
    fingerprint: str
    args: tuple[Any, ...] | dict[str, Any] = ()
    groups: tuple[str, ...] = ()
    implements: tuple[str, ...] = ()
    meta: dict[str, Scalar] = {}
    has_state: bool = False
    state: Any = None


class Prepared(Struct, frozen=True):
    """A prepared provider."""

    ticket: str
    """Offers the provider, once."""
    domain: str
    provider: str
    """Its place once it is offered."""
    services: tuple[str, ...]


class _PreparedProvider(Struct, eq=False):
    caller: str
    provider: object
    snapshot: ProviderSnapshot
    built: BuiltProvider
    provider_cleanup: contextlib.ExitStack
    """Closes the provider; emptied once it is offered."""
    cleanup: contextlib.ExitStack
    """Undoes all that the preparation took, and closes the provider."""
    expiry: ScheduledTask


def fingerprint(provider_class: type, implements: Sequence[type], codec: Codec) -> str:
    """A text that is equal for two classes of one path with the same services and the same version of their state."""
    marked = marked_methods(provider_class, implements)
    services = [
        structs.replace(Signature(name, name, mark, function, codec).info, doc="")
        for name, (mark, function) in sorted(marked.items())
    ]
    version = str(getattr(provider_class, "state_version", ""))
    return hashlib.sha256(
        encode_message((path_of(provider_class), version, is_stateful(provider_class), services))
    ).hexdigest()


class MigrationTarget:
    """Owns the providers that are prepared here and not yet offered."""

    def __init__(
        self,
        own: Address,
        providers: Providers,
        factory: ProviderFactory,
        quiescer: Quiescer,
        access: Authorizer,
        codec: Codec,
        scheduler: Scheduler,
    ) -> None:
        self._own = own
        self._factory = factory
        self._providers = providers
        self._quiescer = quiescer
        self._access = access
        self._codec = codec
        self._scheduler = scheduler
        self._lock = threading.Lock()
        self._slots = threading.BoundedSemaphore(MOST)
        self._prepared: dict[str, _PreparedProvider] = {}
        self._used_tickets: dict[str, None] = {}
        """The last tickets that were used."""

    def prepare(self, snapshot: ProviderSnapshot, caller: str) -> Prepared:
        """Create the provider and give it its state; no client can call it yet.

        Raises:
            AccessDenied: the caller, or this container, may not offer it in its groups.
            NotInstantiable, NoSuchClass, CannotInstantiate: as for `System.instantiate`.
            CannotMigrate: its class is different here, or rejects the state.
            LockedByOther, ConfigurationError: resources that it needs are taken here.
            Busy: too many providers are being prepared.
        """
        self._require(snapshot, caller)
        if not self._slots.acquire(blocking=False):
            raise Busy(service="trade.prepare_arrival", container=self._own.container)
        ticket = secrets.token_hex(8)
        with contextlib.ExitStack() as undo:
            undo.callback(self._slots.release)
            provider_cleanup = undo.enter_context(contextlib.ExitStack())
            instance, built = self._create(snapshot, provider_cleanup)
            self._restore(snapshot, instance, built, undo)
            expiry = self._scheduler.due(lambda: self._expire(ticket))
            with self._lock:
                self._prepared[ticket] = _PreparedProvider(
                    caller, instance, snapshot, built, provider_cleanup, undo.pop_all(), expiry
                )
        expiry.at(time.monotonic_ns() + int(TICKET_S * 1e9))
        domain, _, provider = built.place.partition("/")
        return Prepared(ticket, domain, provider, tuple(built.services))

    def _require(self, snapshot: ProviderSnapshot, caller: str) -> None:
        for group in snapshot.groups or (domain_of(snapshot.groups),):
            self._access.require(caller, "register", group, f"{snapshot.class_path} in {group}")

    def _create(
        self, snapshot: ProviderSnapshot, provider_cleanup: contextlib.ExitStack
    ) -> tuple[object, BuiltProvider]:
        provider_class = self._factory.find(snapshot.class_path)
        implements = [self._interface(path) for path in snapshot.implements]
        if fingerprint(provider_class, implements, self._codec) != snapshot.fingerprint:
            problem = "its class is another version there: other services, other arguments or another state_version"
            raise self._refusal(snapshot, problem)
        provider = self._factory.make(provider_class, snapshot.args)
        provider_cleanup.callback(end, provider)
        groups = checked_groups(provider, snapshot.groups)
        built = self._providers.build(provider, groups, implements, meta=snapshot.meta)
        provider_cleanup.callback(self._providers.discard, built)
        return provider, built

    def _interface(self, path: str) -> type:
        found = imported(path)
        if not isinstance(found, type):
            here = self._own.container
            raise NoSuchClass(class_path=path, container=here, reason="nothing there has imported this interface")
        return found

    def _restore(
        self, snapshot: ProviderSnapshot, provider: object, built: BuiltProvider, undo: contextlib.ExitStack
    ) -> None:
        """Restore under a lock, so that the permit refuses every command that the provider gives meanwhile (S18)."""
        used = {resource for service in built.services.values() for resource in service.resources}
        purpose = f"{snapshot.class_path} arriving"
        frozen = undo.enter_context(
            self._quiescer.frozen(
                built.services, lambda: [one for one in used if not self._providers.groups_of(one.name)], purpose
            )
        )
        if snapshot.has_state:
            try:
                restore(provider, snapshot.state)
                frozen.check()
            except Exception as error:
                with contextlib.suppress(LockedByOther):
                    frozen.seal()  # it may still run, and must not move anything
                raise self._refusal(snapshot, f"restore_state there: {type(error).__name__}: {error}") from error

    def arrive(self, ticket: str, caller: str) -> None:
        """Offer a prepared provider; a ticket is valid once.

        Raises:
            CannotMigrate: the ticket expired, or belongs to another identity.
            AccessDenied: the caller may no longer offer it.
        """
        with self._lock:
            ready = self._prepared.get(ticket)
            if ready is None or ready.caller != caller:
                here = self._own.container
                problem = "the prepared provider has expired there"
                raise CannotMigrate(provider="it", to=here, problem=problem)
            del self._prepared[ticket]
            self._used_tickets[ticket] = None  # before the offer: a container that asks now must not offer it elsewhere
            for forgotten in list(self._used_tickets)[:-_REMEMBERED]:
                del self._used_tickets[forgotten]
        ready.expiry.cancel()
        try:
            self._require(ready.snapshot, caller)
            self._providers.host(ready.built)
        except BaseException:
            self._used_tickets.pop(ticket, None)
            ready.cleanup.close()
            raise
        self._factory.keep(ready.provider, ready.snapshot.args)
        ready.provider_cleanup.pop_all()
        ready.cleanup.close()

    def recreate(
        self, class_path: str, args: Sequence[Any] | Mapping[str, Any], groups: tuple[str, ...], state: Any
    ) -> list[ServiceKey]:
        """Create a provider, give it its state, then offer it.

        Raises:
            CannotInstantiate: it rejects the state, or as for `prepare`.
            NotInstantiable, NoSuchClass, AccessDenied, LockedByOther, ConfigurationError, Busy: as for `prepare`.
        """
        named = dict(args) if isinstance(args, Mapping) else tuple(args)
        version = fingerprint(self._factory.find(class_path), (), self._codec)
        snapshot = ProviderSnapshot(
            class_path=class_path, fingerprint=version, args=named, groups=groups, has_state=True, state=state
        )
        try:
            prepared = self.prepare(snapshot, self._own.identity)
        except CannotMigrate as refused:
            here = self._own.container
            raise CannotInstantiate(class_path=class_path, container=here, problem=refused.problem) from refused
        self.arrive(prepared.ticket, self._own.identity)
        return [ServiceKey(self._own, prepared.domain, prepared.provider, name) for name in prepared.services]

    def arrived(self, ticket: str, caller: str) -> bool:
        """Whether a ticket was used; if not, it becomes invalid."""
        with self._lock:
            ready = self._prepared.get(ticket)
            if ready is not None and ready.caller == caller:
                del self._prepared[ticket]
            else:
                ready = None
            used = ticket in self._used_tickets
        if ready is not None:
            ready.expiry.cancel()
            ready.cleanup.close()
        return used

    def _expire(self, ticket: str) -> None:
        with self._lock:
            ready = self._prepared.pop(ticket, None)
        if ready is not None:
            ready.cleanup.close()

    def close(self) -> None:
        """Close prepared providers that were not fetched. Idempotent."""
        for ticket in list(self._prepared):
            self._expire(ticket)

    def _refusal(self, snapshot: ProviderSnapshot, problem: str) -> CannotMigrate:
        return CannotMigrate(provider=snapshot.class_path, to=self._own.container, problem=problem)
