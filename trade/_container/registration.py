"""The registration methods of a container: register, alter and deregister providers."""

import logging
from collections.abc import Callable, Mapping, Sequence

from msgspec import structs

from trade._calls.client import CallClient
from trade._calls.handle import Handle
from trade._calls.target import container_closed
from trade._estop.deadman import Deadman
from trade._registry.constraints import checked_meta
from trade._services.decorator import provider_of
from trade._services.providers import Providers
from trade._services.registration import checked_groups, checked_health
from trade._services.withdrawn import WithdrawnProviders
from trade.protocol.keys import DOMAIN
from trade.protocol.messages import HEALTHY, ProviderInfo, Scalar
from trade.transport.base import ChannelClosed

_logger = logging.getLogger("trade")


class Registration:
    """Offers objects to the whole system."""

    def __init__(
        self, client: CallClient, providers: Providers, withdrawn_providers: WithdrawnProviders, deadman: Deadman
    ) -> None:
        self._client = client
        self._providers = providers
        self._withdrawn_providers = withdrawn_providers
        self._deadman = deadman

    def register(
        self,
        provider: object,
        groups: str | Sequence[str] = (),
        *,
        implements: Sequence[type] = (),
        meta: Mapping[str, Scalar] | None = None,
    ) -> tuple[Handle, ...]:
        """Offers an object's services to the whole system.

        Args:
            provider: an object whose class, bases or interfaces have ``@service`` methods, or a ``@service`` function.
            groups: dotted labels such as ``"rosie.head"``.
            implements: interfaces (protocols) that the object fits without inheriting from them.
            meta: numbers, texts and booleans by name, for all its services; they override the services' own metadata.

        Returns:
            Handles of its services.

        Raises:
            ConfigurationError: it has no services, a type cannot be sent, a group is malformed, or it is registered
                already.
            AccessDenied: the policy does not let this container offer it in one of these groups.
        """
        provider = provider_of(provider)
        try:
            keys = self._providers.add(provider, checked_groups(provider, groups), implements, meta=meta)
        except ChannelClosed:  # closed by another thread meanwhile
            raise container_closed(self._client.address) from None
        self._withdrawn_providers.forget(provider)
        return tuple(self._client.handle(key) for key in keys)

    def register_functions(self, functions: object, name: str) -> tuple[Handle, ...]:
        """Offers further services of the middleware in group ``trade``; the access table lists the rights they need.

        Args:
            functions: an object with services.
            name: the provider's name, of one object only.
        """
        return tuple(self._client.handle(key) for key in self._providers.add(functions, (DOMAIN,), name=name))

    def deregister(self, provider: object) -> None:
        """Withdraws an object's services from the whole system; handles of them fail from now on.

        Its motion is stopped first, because afterwards no client could. It is withdrawn even if that fails.

        Raises:
            ConfigurationError: it is not registered here.
        """
        provider = provider_of(provider)
        if not self._withdrawn_providers.forget(provider):
            for problem in self._deadman.rest(self._providers.alone_with(provider), "its services are withdrawn"):
                _logger.error("a provider was withdrawn but could not be stopped: %s", problem)
            self._providers.remove(provider)

    def set_groups(self, provider: object, groups: str | Sequence[str]) -> None:
        """Puts a registered provider into other groups. Handles stay valid, since its place does not change.

        Raises:
            ConfigurationError: a malformed group, or it is not registered here.
            AccessDenied: the policy does not let this container offer it in one of these groups.
        """
        named = checked_groups(provider, groups)
        self._alter(provider, lambda info: structs.replace(info, groups=named))

    def add_group(self, provider: object, group: str) -> None:
        """Puts a registered provider into one more group. Raises like `set_groups`."""
        [named] = checked_groups(provider, (group,))
        self._alter(provider, lambda info: structs.replace(info, groups=tuple(dict.fromkeys((*info.groups, named)))))

    def remove_group(self, provider: object, group: str) -> None:
        """Takes a registered provider out of a group; other groups are ignored. Raises like `set_groups`."""
        self._alter(
            provider,
            lambda info: structs.replace(info, groups=tuple(known for known in info.groups if known != group)),
        )

    def set_health(self, provider: object, health: str = HEALTHY) -> None:
        """Reports a provider's problem, such as ``"degraded: overheating"``, or that it is healthy again.

        Raises:
            ConfigurationError: the health is not a text, or it is not registered here.
        """
        checked = checked_health(provider, health)
        self._alter(provider, lambda info: structs.replace(info, health=checked))

    def alter(self, provider: object, *, meta: Mapping[str, Scalar] | None = None) -> None:
        """Reads a registered provider again: its class's ``@service`` marks and its resources. Handles stay valid.

        Args:
            provider: the object.
            meta: replaces its metadata; by default that stays.

        Raises:
            ConfigurationError: like `register`, or it is not registered here.
        """
        new = None if meta is None else checked_meta(meta)
        self._alter(provider, lambda info: info if new is None else structs.replace(info, meta=new), reread=True)

    def _alter(self, provider: object, change: Callable[[ProviderInfo], ProviderInfo], *, reread: bool = False) -> None:
        try:
            self._providers.alter(provider_of(provider), change, reread=reread)
        except ChannelClosed:  # closed by another thread meanwhile
            raise container_closed(self._client.address) from None
