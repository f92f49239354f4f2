"""The side of a migration that a provider comes to: made and given its state first, offered when it has left."""

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
from trade._protocol.codec import Codec
from trade._protocol.keys import Address, ServiceKey, domain_of
from trade._protocol.messages import Scalar, encode_message
from trade._protocol.schema_types import imported
from trade._security.authorizer import Authorizer
from trade._services.decorator import marked_methods
from trade._services.providers import Providers
from trade._services.registration import Built, checked_groups
from trade._services.signature import Signature
from trade._threads.scheduler import ScheduledTask, Scheduler
from trade.errors import Busy, CannotInstantiate, CannotMigrate, LockedByOther, NoSuchClass

TICKET_S: Final = 20.0
"""What was prepared and is not fetched in this time is closed again."""
MOST: Final = 8
"""So many may be prepared at once."""
_REMEMBERED: Final = 256


class ProviderSnapshot(Struct, frozen=True, kw_only=True):
    """What is made of a provider elsewhere, and how it is offered."""

    class_path: str
    fingerprint: str
    args: tuple[Any, ...] | dict[str, Any] = ()
    groups: tuple[str, ...] = ()
    implements: tuple[str, ...] = ()
    meta: dict[str, Scalar] = {}
    has_state: bool = False
    state: Any = None


class Prepared(Struct, frozen=True):
    """It stands ready."""

    ticket: str
    """Offers it, once."""
    domain: str
    provider: str
    """Where it will be offered."""
    services: tuple[str, ...]


class _Ready(Struct, eq=False):
    caller: str
    provider: object
    luggage: ProviderSnapshot
    built: Built
    ending: contextlib.ExitStack
    """Closes it; to be emptied if it is offered."""
    standing: contextlib.ExitStack
    """Ends all that was taken up for it, and closes it."""
    due: ScheduledTask


def fingerprint(kind: type, implements: Sequence[type], codec: Codec) -> str:
    """Two classes of one path with the same services and the same version of their state have the same one."""
    marked = marked_methods(kind, implements)
    told = [
        structs.replace(Signature(name, name, mark, function, codec).info, doc="")
        for name, (mark, function) in sorted(marked.items())
    ]
    version = str(getattr(kind, "state_version", ""))
    return hashlib.sha256(encode_message((path_of(kind), version, is_stateful(kind), told))).hexdigest()


class MigrationTarget:
    """Owns what was prepared here and is not offered yet."""

    def __init__(
        self,
        own: Address,
        providers: Providers,
        making: ProviderFactory,
        freezing: Quiescer,
        access: Authorizer,
        codec: Codec,
        scheduler: Scheduler,
    ) -> None:
        self._own = own
        self._making = making
        self._providers = providers
        self._freezing = freezing
        self._access = access
        self._codec = codec
        self._scheduler = scheduler
        self._lock = threading.Lock()
        self._places = threading.BoundedSemaphore(MOST)
        self._ready: dict[str, _Ready] = {}
        self._arrived: dict[str, None] = {}
        """The last tickets that were used."""

    def prepare(self, luggage: ProviderSnapshot, caller: str) -> Prepared:
        """Make it and give it its state; nobody can call it yet.

        Raises:
            AccessDenied: who asks, or this container, may not offer it in its groups.
            NotInstantiable, NoSuchClass, CannotInstantiate: as for `System.instantiate`.
            CannotMigrate: the class is another one here, or does not take the state.
            LockedByOther, ConfigurationError: what it needs here is taken.
            Busy: too many are being prepared.
        """
        self._require(luggage, caller)
        if not self._places.acquire(blocking=False):
            raise Busy(service="trade.prepare_arrival", container=self._own.container)
        ticket = secrets.token_hex(8)
        with contextlib.ExitStack() as undo:
            undo.callback(self._places.release)
            ending = undo.enter_context(contextlib.ExitStack())
            made, built = self._make(luggage, ending)
            self._restore(luggage, made, built, undo)
            due = self._scheduler.due(lambda: self._over(ticket))
            with self._lock:
                self._ready[ticket] = _Ready(caller, made, luggage, built, ending, undo.pop_all(), due)
        due.at(time.monotonic_ns() + int(TICKET_S * 1e9))
        domain, _, provider = built.place.partition("/")
        return Prepared(ticket, domain, provider, tuple(built.services))

    def _require(self, luggage: ProviderSnapshot, caller: str) -> None:
        for group in luggage.groups or (domain_of(luggage.groups),):
            self._access.require(caller, "register", group, f"{luggage.class_path} in {group}")

    def _make(self, luggage: ProviderSnapshot, ending: contextlib.ExitStack) -> tuple[object, Built]:
        kind = self._making.find(luggage.class_path)
        implements = [self._interface(path) for path in luggage.implements]
        if fingerprint(kind, implements, self._codec) != luggage.fingerprint:
            problem = "its class is another version there: other services, other arguments or another state_version"
            raise self._refusal(luggage, problem)
        made = self._making.make(kind, luggage.args)
        ending.callback(end, made)
        groups = checked_groups(made, luggage.groups)
        built = self._providers.build(made, groups, implements, meta=luggage.meta)
        ending.callback(self._providers.discard, built)
        return made, built

    def _interface(self, path: str) -> type:
        found = imported(path)
        if not isinstance(found, type):
            here = self._own.container
            raise NoSuchClass(class_path=path, container=here, reason="nothing there has imported this interface")
        return found

    def _restore(self, luggage: ProviderSnapshot, made: object, built: Built, undo: contextlib.ExitStack) -> None:
        """Under a lock, so that whatever it commands is refused at its permit (S18)."""
        used = {resource for service in built.services.values() for resource in service.resources}
        purpose = f"{luggage.class_path} arriving"
        still = undo.enter_context(
            self._freezing.frozen(
                built.services, lambda: [one for one in used if not self._providers.groups_of(one.name)], purpose
            )
        )
        if luggage.has_state:
            try:
                restore(made, luggage.state)
                still.check()
            except Exception as error:
                with contextlib.suppress(LockedByOther):
                    still.seal()  # it may go on for all we know, and is still not to move anything
                raise self._refusal(luggage, f"restore_state there: {type(error).__name__}: {error}") from error

    def arrive(self, ticket: str, caller: str) -> None:
        """Offer what was prepared; a ticket is good once.

        Raises:
            CannotMigrate: it has been too long, or another one prepared it.
            AccessDenied: who asks may not offer it any more.
        """
        with self._lock:
            ready = self._ready.get(ticket)
            if ready is None or ready.caller != caller:
                here = self._own.container
                problem = "what was prepared there is not there any more"
                raise CannotMigrate(provider="it", to=here, problem=problem)
            del self._ready[ticket]
            self._arrived[ticket] = None  # before it is offered: whoever asks now must not offer it elsewhere
            for forgotten in list(self._arrived)[:-_REMEMBERED]:
                del self._arrived[forgotten]
        ready.due.cancel()
        try:
            self._require(ready.luggage, caller)
            self._providers.host(ready.built)
        except BaseException:
            self._arrived.pop(ticket, None)
            ready.standing.close()
            raise
        self._making.keep(ready.provider, ready.luggage.args)
        ready.ending.pop_all()
        ready.standing.close()

    def bring_back(
        self, class_path: str, args: Sequence[Any] | Mapping[str, Any], groups: tuple[str, ...], state: Any
    ) -> list[ServiceKey]:
        """Make something, give it its state, then offer it.

        Raises:
            CannotInstantiate: it does not take the state, or as for `prepare`.
            NotInstantiable, NoSuchClass, AccessDenied, LockedByOther, ConfigurationError, Busy: as for `prepare`.
        """
        named = dict(args) if isinstance(args, Mapping) else tuple(args)
        version = fingerprint(self._making.find(class_path), (), self._codec)
        luggage = ProviderSnapshot(
            class_path=class_path, fingerprint=version, args=named, groups=groups, has_state=True, state=state
        )
        try:
            prepared = self.prepare(luggage, self._own.identity)
        except CannotMigrate as refused:
            here = self._own.container
            raise CannotInstantiate(class_path=class_path, container=here, problem=refused.problem) from refused
        self.arrive(prepared.ticket, self._own.identity)
        return [ServiceKey(self._own, prepared.domain, prepared.provider, name) for name in prepared.services]

    def arrived(self, ticket: str, caller: str) -> bool:
        """Whether a ticket was used; if it was not, it is good no more."""
        with self._lock:
            ready = self._ready.get(ticket)
            if ready is not None and ready.caller == caller:
                del self._ready[ticket]
            else:
                ready = None
            used = ticket in self._arrived
        if ready is not None:
            ready.due.cancel()
            ready.standing.close()
        return used

    def _over(self, ticket: str) -> None:
        with self._lock:
            ready = self._ready.pop(ticket, None)
        if ready is not None:
            ready.standing.close()

    def close(self) -> None:
        """Close what nobody fetched. Idempotent."""
        for ticket in list(self._ready):
            self._over(ticket)

    def _refusal(self, luggage: ProviderSnapshot, problem: str) -> CannotMigrate:
        return CannotMigrate(provider=luggage.class_path, to=self._own.container, problem=problem)
