"""The rules of registration, and the record of each registered object."""

from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

from msgspec import Struct

from trade._services.decorator import ServiceMark
from trade._services.local_service import LocalService
from trade.errors import ConfigurationError
from trade.protocol.keys import DOMAIN, GROUP, ServiceKey, is_chunk
from trade.protocol.messages import ProviderInfo, Scalar

_LONGEST_HEALTH: Final = 500


def require_stop(kind: str, resources: Sequence[object], marks: Sequence[ServiceMark]) -> None:
    """S17: a provider that moves something physical must have a way to stop it."""
    physical = resources or any(mark.uses for mark in marks)
    effects = {mark.effect for mark in marks}
    if physical and "actuate" in effects and "stop" not in effects:
        problem = 'it moves something but cannot be stopped; give it a method marked @service(effect="stop")'
        raise ConfigurationError(where=kind, problem=problem)


def checked_groups(provider: object, groups: str | Sequence[str]) -> tuple[str, ...]:
    """Groups as a tuple; raises ConfigurationError for one that is malformed or the middleware's own."""
    named = (groups,) if isinstance(groups, str) else tuple(groups)
    for group in named:
        is_text = isinstance(group, str)  # pyright: ignore[reportUnnecessaryIsInstance] - callers may not check types
        if not is_text or not GROUP.fullmatch(group) or not is_chunk(group) or group.split(".")[0] == DOMAIN:
            problem = (
                f"{group!r} is no group; use words joined by dots, such as rosie.head, 80 characters at most "
                f"({DOMAIN!r} is reserved)"
            )
            raise ConfigurationError(where=type(provider).__qualname__, problem=problem)
    return named


def checked_health(provider: object, health: str) -> str:
    """A health text; raises ConfigurationError for an invalid one."""
    if not isinstance(health, str) or not 0 < len(health) <= _LONGEST_HEALTH:  # pyright: ignore[reportUnnecessaryIsInstance]
        problem = f"health must be a text of 1 to {_LONGEST_HEALTH} characters that says what is wrong, or 'healthy'"
        raise ConfigurationError(where=type(provider).__qualname__, problem=problem)
    return health


class RegisteredProvider(Struct, frozen=True):
    """A provider of this container."""

    provider: Any
    services: dict[str, LocalService]
    implements: tuple[type, ...]
    info: ProviderInfo
    """As it was last announced."""


class ProviderOffer(NamedTuple):
    """An object with its registration."""

    provider: object
    groups: tuple[str, ...]
    implements: tuple[type, ...]
    meta: Mapping[str, Scalar]


class BuiltProvider(NamedTuple):
    """An object read into services that are not offered yet; it holds its resources."""

    place: str
    registered: RegisteredProvider
    keys: tuple[ServiceKey, ...]

    @property
    def services(self) -> dict[str, LocalService]:
        return self.registered.services
