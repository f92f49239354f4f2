"""Providers that were withdrawn through the system, kept by their container to be offered again."""

import threading
from collections.abc import Callable, Sequence
from typing import Final

from msgspec import Struct

from trade._resources.resource import Resource
from trade._services.providers import Providers
from trade._services.registration import ProviderOffer, checked_groups
from trade.errors import ConfigurationError, DeviceFault
from trade.protocol.keys import DOMAIN, ServiceKey


class WithdrawnInfo(Struct, frozen=True):
    """A provider that was deregistered through its container and can be registered again by its name."""

    provider: str
    kind: str
    groups: tuple[str, ...]


class WithdrawnProviders:
    """Owns the withdrawn providers; the code that registered an object keeps the final say over it."""

    def __init__(self, providers: Providers, rest: Callable[[Sequence[Resource], str], list[str]]) -> None:
        self._providers: Final = providers
        self._rest: Final = rest
        self._lock = threading.Lock()
        self._offers: dict[str, ProviderOffer] = {}

    def take_off(self, key: ServiceKey, moved_to: str = "") -> str:
        """Stop offering the provider of a service; returns the name under which it can be offered again.

        It stops its motion first: afterwards no client could. ``moved_to`` is its new place, if it moved.

        Raises:
            ConfigurationError: it is not offered here, or is the middleware's own.
            DeviceFault: it could not be stopped; it is still offered.
        """
        if key.domain == DOMAIN:
            raise ConfigurationError(where=key.provider, problem="the middleware's own services cannot be withdrawn")
        offer = self._providers.offer(f"{key.domain}/{key.provider}")
        if offer is None:
            raise ConfigurationError(where=key.provider, problem=f"container {key.address.container} does not offer it")
        if problems := self._rest(self._providers.alone_with(offer.provider), "its services are withdrawn"):
            raise DeviceFault(device=key.provider, bus=key.address.container, fault="; ".join(problems))
        with self._lock:
            self._offers[key.provider] = offer
        try:
            self._providers.remove(offer.provider, moved_to)
        except ConfigurationError:  # another thread was faster; perhaps its owner, which has the final say
            self.forget(offer.provider)
            raise
        return key.provider

    def put_back(self, provider: str, groups: str | Sequence[str] | None) -> list[ServiceKey]:
        """Offer a provider again, in other groups if some are given. Returns the keys of its services.

        Raises:
            ConfigurationError: no such provider was withdrawn, or a malformed group.
        """
        with self._lock:
            offer = self._offers.get(provider)
            known = ", ".join(self._offers) or "none"
        if offer is None:
            problem = f"no provider of that name was withdrawn; there is {known}"
            raise ConfigurationError(where=provider, problem=problem)
        named = offer.groups if groups is None else checked_groups(offer.provider, groups)
        keys = self._providers.add(offer.provider, named, offer.implements, meta=offer.meta)
        self.forget(offer.provider)
        return keys

    def forget(self, provider: object) -> bool:
        """Its owner registers or deregisters it; returns whether it was withdrawn."""
        with self._lock:
            names = [name for name, offer in self._offers.items() if offer.provider is provider]
            for name in names:
                del self._offers[name]
        return bool(names)

    def offer(self, provider: str) -> ProviderOffer | None:
        """The provider withdrawn under a name, with its registration."""
        with self._lock:
            return self._offers.get(provider)

    def infos(self) -> list[WithdrawnInfo]:
        """The providers that can be offered again, by name."""
        with self._lock:
            kept = sorted(self._offers.items())
        return [WithdrawnInfo(name, type(offer.provider).__qualname__, offer.groups) for name, offer in kept]
