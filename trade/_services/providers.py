"""The providers of a container: reads objects into services, announces and withdraws them."""

import inspect
import os
import socket
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, cast
from weakref import WeakValueDictionary

from msgspec import structs

from trade._audit.events import Audit
from trade._discovery.announcer import Announcer
from trade._registry.constraints import checked_meta
from trade._registry.registry import Record, Registry, gone_to, records_of
from trade._resources.lock_table import LockTable
from trade._resources.resource import Resource
from trade._security.authorizer import Authorizer
from trade._services.decorator import ServiceMark, check_of, kinds_of, marked_methods
from trade._services.event_loop import AsyncLoop
from trade._services.local_service import LocalService
from trade._services.registration import BuiltProvider, ProviderOffer, RegisteredProvider, require_stop
from trade._services.serial_queue import SerialQueue
from trade._services.signature import Signature
from trade.errors import ConfigurationError
from trade.protocol.codec import Codec
from trade.protocol.keys import DOMAIN, Address, ServiceKey, as_chunk, domain_of
from trade.protocol.messages import ProviderInfo, Scalar, ServiceInfo

_MOST_MOVED: Final = 4096

_Method = tuple[str, ServiceMark, Callable[..., Any]]


class Providers:
    """Owns the hosted providers, and informs the registry and the rest of the system about them."""

    def __init__(
        self,
        announcer: Announcer,
        registry: Registry,
        own: Address,
        codec: Codec,
        loop: AsyncLoop,
        table: LockTable,
        access: Authorizer,
        audit: Audit,
    ) -> None:
        self._audit = audit
        self._access = access
        self._announcer = announcer
        self._registry = registry
        self._own = own
        self._codec = codec
        self._loop = loop
        self._table = table
        self._lock = threading.Lock()
        self._announcing = threading.RLock()
        """Serialises announcements: revisions go out in order."""
        self._revision = 0
        self._hosted: dict[str, RegisteredProvider] = {}
        self._names: dict[int, str] = {}
        self._moved: dict[str, str] = {}
        """By place, where the providers went that moved away last."""
        self._counter = 0
        self.prepare: Callable[[Sequence[Record], Mapping[str, LocalService]], None] = _nothing
        """Called for the services of a provider, by name, before they are offered or change."""
        self._signatures: WeakValueDictionary[_Method, Signature] = WeakValueDictionary()
        """Signatures that objects of one class share while one of them is hosted."""

    def add(
        self,
        provider: object,
        groups: tuple[str, ...],
        implements: Sequence[type] = (),
        *,
        meta: Mapping[str, Scalar] | None = None,
        name: str | None = None,
    ) -> list[ServiceKey]:
        """Host an object: callable first, announced then. Returns the keys of its services.

        Args:
            provider: the object; kept until it is removed.
            groups: dotted labels, checked by the caller of this.
            implements: interfaces in addition to those it inherits from.
            meta: metadata of all its services; it overrides their own.
            name: name of the provider in keys; by default its class and a number.

        Raises:
            ConfigurationError, AccessDenied: see `Container.register`.
        """
        built = self.build(provider, groups, implements, meta=meta, name=name)
        self.host(built)
        return list(built.keys)

    def build(
        self,
        provider: object,
        groups: tuple[str, ...],
        implements: Sequence[type] = (),
        *,
        meta: Mapping[str, Scalar] | None = None,
        name: str | None = None,
    ) -> BuiltProvider:
        """Do all of `add` that can fail: `host` then offers the result, or `discard` gives its resources back."""
        kind, domain = type(provider).__qualname__, domain_of(groups)
        if domain != DOMAIN:
            self._access.require_offer(self._own.identity, groups, kind)
        chunk = name or self._new_chunk(provider, type(provider).__name__)
        place = f"{domain}/{chunk}"
        services = self._services_of(provider, groups, implements, place)
        info = ProviderInfo(
            revision=1,  # assigned before it is announced
            groups=groups,
            kind=kind,
            host=socket.gethostname(),
            pid=os.getpid(),
            services=_infos(services),
            kinds=(kind,) if domain == DOMAIN else kinds_of(type(provider), implements),
            meta=checked_meta({**_own_meta(provider), **(meta or {})}),
            members={group: tuple(names) for group, names in getattr(provider, "members", {}).items()},
            estops=getattr(provider, "open_estops", ()) if domain == DOMAIN else (),
        )
        keys = tuple(ServiceKey(self._own, domain, chunk, service) for service in services)
        return BuiltProvider(place, RegisteredProvider(provider, services, tuple(implements), info), keys)

    def host(self, built: BuiltProvider) -> None:
        """Offer what was built: callable first, then announced."""
        self._host(built.place, built.registered)

    def discard(self, built: BuiltProvider) -> None:
        """Give back what was built and is not offered."""
        self._drop(built.services)

    def pass_on(
        self, provider: object, info: ProviderInfo, make: Callable[[str], dict[str, LocalService]]
    ) -> tuple[str, str]:
        """Host a proxy for a provider of another system, described by that one's data. Returns domain and name.

        Args:
            provider: the proxy; kept until it is removed.
            info: the description of the remote provider.
            make: makes its services, for the place (``domain/provider``) that it gets.

        Raises:
            ConfigurationError: another provider here uses its resources.
            AccessDenied: this container may not offer it in these groups.
        """
        self._access.require_offer(self._own.identity, info.groups, info.kind)
        domain, chunk = domain_of(info.groups), self._new_chunk(provider, info.kind)
        place = f"{domain}/{chunk}"
        self._host(place, RegisteredProvider(provider, make(place), (), info))
        return domain, chunk

    def _new_chunk(self, provider: object, kind: str) -> str:
        with self._lock:
            self._require_new(provider)
            self._counter += 1
            return f"{as_chunk(kind)[:60]}-{self._counter}"

    def _host(self, place: str, registered: RegisteredProvider) -> None:
        with self._announcing:
            self._watch(place, registered.services)
            self._prepare(place, registered.services, registered.info)
            with self._lock:
                self._require_new(registered.provider)
                self._names[id(registered.provider)] = place
                self._hosted[place] = registered
            self._announce(place, registered.info)

    def _watch(self, place: str, services: Mapping[str, LocalService]) -> None:
        for service in services.values():
            self._audit.watch(place.partition("/")[0], service)

    def _prepare(self, place: str, services: Mapping[str, LocalService], info: ProviderInfo) -> None:
        domain, _, chunk = place.partition("/")
        self.prepare(records_of(self._own, domain, chunk, info, local=True), services)

    def prepare_again(self) -> None:
        """Prepare all services once more: what `prepare` depends on has changed."""
        with self._announcing:
            for place, registered in self._hosted.copy().items():
                self._prepare(place, registered.services, registered.info)

    def _require_new(self, provider: object) -> None:
        if id(provider) in self._names:
            problem = "this object is registered already; deregister it first"
            raise ConfigurationError(where=type(provider).__qualname__, problem=problem)

    def alter(self, provider: object, change: Callable[[ProviderInfo], ProviderInfo], *, reread: bool = False) -> None:
        """Announce a changed description of a provider, in a new revision. Its place stays: handles remain valid.

        Args:
            provider: the object.
            change: turns the announced description into the new one.
            reread: read its class and resources again, too; running calls end with the old ones.

        Raises:
            ConfigurationError: it is not registered here, or its class has become invalid.
            AccessDenied: this container may not offer it in these groups.
        """
        with self._announcing:
            place, known = self._known(provider)
            info = change(known.info)
            if info.groups != known.info.groups:
                self._access.require_offer(self._own.identity, info.groups, info.kind)
            services = known.services
            if reread:
                self._signatures.clear()
                services = self._services_of(provider, info.groups, known.implements, place)
                self._watch(place, services)
                kinds = kinds_of(type(provider), known.implements)
                info = structs.replace(info, services=_infos(services), kinds=kinds)
            if not reread and info == known.info:
                return
            self._prepare(place, services, info)
            with self._lock:
                self._hosted[place] = structs.replace(known, services=services, info=info)
            if reread:
                self._drop(known.services)
            self._announce(place, info)

    def _known(self, provider: object) -> tuple[str, RegisteredProvider]:
        with self._lock:
            place = self._names.get(id(provider))
            if place is None:
                raise _not_registered(provider)
            return place, self._hosted[place]

    def _announce(self, place: str, info: ProviderInfo) -> None:
        """Update the local registry first, then announce to all; in the next revision."""
        self._revision += 1
        info = structs.replace(info, revision=self._revision)
        domain, _, chunk = place.partition("/")
        self._registry.put(self._own, domain, chunk, info)
        self._announcer.announce(domain, chunk, info)

    def remove(self, provider: object, moved_to: str = "") -> None:
        """Stop hosting an object: removed from the registry first, then uncallable.

        Args:
            provider: the object.
            moved_to: its new place, if another container took it over: ``identity/container/epoch/domain/provider``.

        Raises:
            ConfigurationError: it is not registered here.
        """
        with self._announcing:
            with self._lock:
                place = self._names.pop(id(provider), None)
                if place is None:
                    raise _not_registered(provider)
                registered = self._hosted.pop(place)
                if moved_to:
                    self._moved[place] = moved_to
                    for forgotten in list(self._moved)[:-_MOST_MOVED]:
                        del self._moved[forgotten]
            self._announce(place, structs.replace(registered.info, services=(), moved_to=moved_to))
            self._drop(registered.services)

    def _drop(self, services: Mapping[str, LocalService]) -> None:
        for service in services.values():
            for resource in service.resources:
                self._table.drop(resource)

    def alone_with(self, provider: object) -> list[Resource]:
        """The resources that services of a registered object use, and no others do."""
        used: dict[bool, set[Resource]] = {True: set(), False: set()}
        for registered in list(self._hosted.values()):
            for service in registered.services.values():
                used[registered.provider is provider].update(service.resources)
        return sorted(used[True] - used[False], key=lambda resource: resource.name)

    def stop_of(self, resource: Resource) -> LocalService | None:
        """The service that stops a resource and the fewest others."""
        found = [
            service
            for registered in list(self._hosted.values())
            for service in registered.services.values()
            if service.effect == "stop" and resource in service.resources
        ]
        return min(found, key=lambda service: len(service.resources), default=None)

    def groups_of(self, resource: str) -> set[str]:
        """The groups, in the form of keys, of the services that use a resource."""
        return {
            place.partition("/")[0]
            for place, registered in self._hosted.copy().items()
            for service in registered.services.values()
            if any(one.name == resource for one in service.resources)
        }

    def stops(self) -> list[LocalService]:
        """All stop services without required arguments, except the middleware's own."""
        return [
            service
            for place, registered in self._hosted.copy().items()
            for service in registered.services.values()
            if service.effect == "stop" and not place.startswith(f"{DOMAIN}/")
            if not any(parameter.required for parameter in service.signature.info.parameters)
        ]

    def waiting(self) -> int:
        """The number of calls that wait in queues of serial services."""
        services = [service for hosted in list(self._hosted.values()) for service in hosted.services.values()]
        return sum(serial.waiting for serial in {service.serial for service in services} if serial is not None)

    def offer(self, place: str) -> ProviderOffer | None:
        """The provider registered at a place (``domain/provider``)."""
        known = self._hosted.get(place)
        return (
            None
            if known is None
            else ProviderOffer(known.provider, known.info.groups, known.implements, known.info.meta)
        )

    def lookup(self, place: str, service: str) -> LocalService | None:
        """The service that a call names.

        Args:
            place: ``domain/provider``. The domain must be the provider's own: access rules apply to it.
            service: its name.

        Raises:
            ServiceGone: its provider has moved; the error names the new place.
        """
        registered = self._hosted.get(place)
        if registered is None:
            if (moved_to := self._moved.get(place)) is not None:
                raise gone_to(f"{place.partition('/')[0]}.{service}", moved_to)
            return None
        return registered.services.get(service)

    def services_at(self, place: str) -> Mapping[str, LocalService]:
        """The services at a place, by name."""
        registered = self._hosted.get(place)
        return {} if registered is None else registered.services

    def service(self, key: ServiceKey) -> LocalService | None:
        """A service of this container by its key."""
        return self.services_at(f"{key.domain}/{key.provider}").get(key.name)

    def _services_of(
        self, provider: object, groups: tuple[str, ...], implements: Sequence[type], place: str
    ) -> dict[str, LocalService]:
        kind = type(provider).__qualname__
        marked = marked_methods(type(provider), implements)
        if not marked:
            problem = "it has no services; mark methods of its class with @trade.service"
            if isinstance(provider, type):
                kind, problem = provider.__qualname__, "it is a class; register an object of it"
            elif inspect.isfunction(provider):
                kind, problem = provider.__qualname__, "it is no service; mark it with @trade.service"
            raise ConfigurationError(where=kind, problem=problem)
        resources = cast("tuple[Resource | str, ...]", tuple(getattr(provider, "resources", ())))
        require_stop(kind, resources, [mark for mark, _ in marked.values()])
        serial = SerialQueue()
        services: dict[str, LocalService] = {}
        for name, (mark, function) in marked.items():
            label = f"{groups[0] if groups else kind}.{name}"
            if not mark.strict and mark.effect != "read" and (mark.uses or resources):
                problem = "it needs physical resources, so its arguments are always checked; leave out strict=False"
                raise ConfigurationError(where=label, problem=problem)
            signature = self._signature(label, name, mark, function)
            info = signature.info
            if resources and mark.effect not in {"read", "note"}:
                names = [one if isinstance(one, str) else one.name for one in resources]
                info = structs.replace(info, uses=tuple(dict.fromkeys((*mark.uses, *names))))
            services[name] = made = LocalService(
                label,
                info,
                signature,
                getattr(provider, name),
                mark,
                self._loop,
                serial if mark.serial else None,
                self._adopt(mark, (*resources, *mark.uses), f"{place}/{name}"),
            )
            made.check = check_of(provider, name, mark)
        return services

    def _signature(self, where: str, name: str, mark: ServiceMark, function: Callable[..., Any]) -> Signature:
        """The signature that other objects of the class already have, or a new one."""
        key = (name, mark, function)
        found = self._signatures.get(key)
        if found is None:
            found = self._signatures[key] = Signature(where, name, mark, function, self._codec)
        return found

    def _adopt(self, mark: ServiceMark, needed: Sequence[Resource | str], itself: str) -> tuple[Resource, ...]:
        """The resources that a service needs; a service that names none, or only reads, can be locked by itself."""
        if itself.startswith(f"{DOMAIN}/") or mark.effect == "note":
            return ()
        if mark.effect == "read" or (not needed and mark.effect == "actuate"):
            needed = (itself,)
        given = {one.name for one in needed if isinstance(one, Resource)}
        try:
            return tuple(self._table.adopt(one) for one in dict.fromkeys(needed) if one not in given)
        except ValueError as twice:
            raise ConfigurationError(where=itself, problem=str(twice)) from None


def _infos(services: Mapping[str, LocalService]) -> tuple[ServiceInfo, ...]:
    return tuple(service.info for service in services.values())


def _not_registered(provider: object) -> ConfigurationError:
    return ConfigurationError(where=type(provider).__qualname__, problem="it is not registered in this container")


def _own_meta(provider: object) -> dict[str, Scalar]:
    """What others need to know of its class: that it can move to another host although it drives something (S20)."""
    return {"relocatable": True} if getattr(provider, "relocatable", False) is True else {}


def _nothing(records: Sequence[Record], services: Mapping[str, LocalService]) -> None:
    """Leaves services as they are."""
