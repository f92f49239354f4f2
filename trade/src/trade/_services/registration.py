"""What is known of the objects a container offers."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from msgspec import Struct

from trade._protocol.keys import ServiceKey
from trade._protocol.messages import ProviderInfo, Scalar
from trade._services.local_service import LocalService


class Registered(Struct, frozen=True):
    """A provider of this container."""

    provider: Any
    services: dict[str, LocalService]
    implements: tuple[type, ...]
    info: ProviderInfo
    """As it was announced last."""


class Offer(NamedTuple):
    """An object, and how it is registered."""

    provider: object
    groups: tuple[str, ...]
    implements: tuple[type, ...]
    meta: Mapping[str, Scalar]


class Built(NamedTuple):
    """An object read into services, which are not offered yet; its resources are adopted."""

    place: str
    registered: Registered
    keys: tuple[ServiceKey, ...]

    @property
    def services(self) -> dict[str, LocalService]:
        return self.registered.services
