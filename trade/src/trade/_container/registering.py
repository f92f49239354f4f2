"""Registering objects, altering and withdrawing them."""

import logging
from collections.abc import Callable, Mapping, Sequence

from msgspec import structs

from trade._calls.handle import Handle
from trade._calls.target import container_closed
from trade._container.lookup import Lookup
from trade._estop.deadman import Deadman
from trade._protocol.keys import DOMAIN
from trade._protocol.messages import HEALTHY, ProviderInfo, Scalar
from trade._registry.constraints import checked_meta
from trade._services.providers import Providers
from trade._services.registration import checked_groups, checked_health
from trade._services.withdrawn import Withdrawn
from trade._transport.base import ChannelClosed

_logger = logging.getLogger("trade")


class Registering:
    """Offers objects to the whole system."""

    def __init__(self, lookup: Lookup, providers: Providers, withdrawn: Withdrawn, deadman: Deadman) -> None:
        self._lookup = lookup
        self._providers = providers
        self._withdrawn = withdrawn
        self._deadman = deadman

    def register(
        self,
        provider: object,
        groups: str | Sequence[str] = (),
        *,
        implements: Sequence[type] = (),
        meta: Mapping[str, Scalar] | None = None,
    ) -> tuple[Handle, ...]:
        """Offer an object's services to the whole system.

        Args:
            provider: an object whose class, bases or interfaces have ``@service`` methods.
            groups: dotted labels such as ``"rosie.head"``.
            implements: interfaces (protocols) the object fits without inheriting from them.
            meta: numbers, texts, booleans by name; holds for all its services, over what they say themselves.

        Returns:
            Handles of its services.

        Raises:
            ConfigurationError: nothing to offer, a type that cannot be sent, a malformed group, or it is registered
                already.
            AccessDenied: the policy does not let this container offer it in one of these groups.
        """
        try:
            keys = self._providers.add(provider, checked_groups(provider, groups), implements, meta=meta)
        except ChannelClosed:  # closed by another thread meanwhile
            raise container_closed(self._lookup.home.address) from None
        self._withdrawn.forget(provider)
        return tuple(self._lookup.handle(key) for key in keys)

    def register_functions(self, functions: object, name: str) -> tuple[Handle, ...]:
        """Offer further functions of the middleware in group ``trade``; what they need is in the table of access.

        Args:
            functions: an object with services.
            name: of the provider; one name, one object.
        """
        return tuple(self._lookup.handle(key) for key in self._providers.add(functions, (DOMAIN,), name=name))

    def deregister(self, provider: object) -> None:
        """Withdraw an object's services from the whole system; handles of them fail from now on.

        What it moves is stopped first, because afterwards nobody could. It is withdrawn even if that fails.

        Raises:
            ConfigurationError: it is not registered here.
        """
        if not self._withdrawn.forget(provider):
            for problem in self._deadman.rest(self._providers.alone_with(provider), "its services are withdrawn"):
                _logger.error("withdrawn without having been stopped: %s", problem)
            self._providers.remove(provider)

    def set_groups(self, provider: object, groups: str | Sequence[str]) -> None:
        """Put a live provider into other groups. Handles stay valid: its place was settled when it was registered.

        Raises:
            ConfigurationError: a malformed group, or it is not registered here.
            AccessDenied: the policy does not let this container offer it in one of these groups.
        """
        named = checked_groups(provider, groups)
        self._alter(provider, lambda info: structs.replace(info, groups=named))

    def add_group(self, provider: object, group: str) -> None:
        """Put a live provider into one more group. Raises like `set_groups`."""
        [named] = checked_groups(provider, (group,))
        self._alter(provider, lambda info: structs.replace(info, groups=tuple(dict.fromkeys((*info.groups, named)))))

    def remove_group(self, provider: object, group: str) -> None:
        """Take a live provider out of a group; one it is not in is fine. Raises like `set_groups`."""
        self._alter(
            provider,
            lambda info: structs.replace(info, groups=tuple(known for known in info.groups if known != group)),
        )

    def set_health(self, provider: object, health: str = HEALTHY) -> None:
        """Say what is wrong with a provider, such as ``"degraded: overheating"``, or that nothing is any more.

        Raises:
            ConfigurationError: no text, or it is not registered here.
        """
        said = checked_health(provider, health)
        self._alter(provider, lambda info: structs.replace(info, health=said))

    def alter(self, provider: object, *, meta: Mapping[str, Scalar] | None = None) -> None:
        """Read a live provider again, as if it were registered anew: its class's marks, its resources. Handles hold.

        Args:
            provider: the object.
            meta: instead of the metadata it was registered with; by default that stays.

        Raises:
            ConfigurationError: like `register`, or it is not registered here.
        """
        new = None if meta is None else checked_meta(meta)
        self._alter(provider, lambda info: info if new is None else structs.replace(info, meta=new), reread=True)

    def _alter(self, provider: object, change: Callable[[ProviderInfo], ProviderInfo], *, reread: bool = False) -> None:
        try:
            self._providers.alter(provider, change, reread=reread)
        except ChannelClosed:  # closed by another thread meanwhile
            raise container_closed(self._lookup.home.address) from None
