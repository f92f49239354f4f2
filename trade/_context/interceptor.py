"""Interceptors around a served call, the outermost first.

Audit comes first and sees what the others do; then spans, then hooks. Each one calls the next, and the last one calls
the service.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

from trade._context.call_context import CallContext
from trade.protocol.messages import ServiceInfo


class ServiceSignature(Protocol):
    """The part of a signature that interceptors use."""

    has_secrets: bool

    def named(self, args: Sequence[Any], kwargs: Mapping[str, Any]) -> dict[str, Any]: ...


class ServedService(Protocol):
    """A service of this container, as interceptors see it."""

    label: str
    info: ServiceInfo
    effect: str
    interceptors: "tuple[Interceptor, ...]"

    @property
    def signature(self) -> ServiceSignature: ...

    def too_late(self, expires_ns: int | None) -> bool: ...


class ServedCall(NamedTuple):
    """One call of a service of this container."""

    service: ServedService
    args: Sequence[Any]
    kwargs: dict[str, Any]
    context: CallContext


class CallGuard(Protocol):
    """Code that may refuse a call once it is admitted, before the service runs."""

    def require(self, call: ServedCall) -> None:
        """Raises CallRefused, or the reason why the call must no longer run."""
        ...


class Interceptor(ABC):
    """Code that runs in place of a service, and calls it with ``proceed()``."""

    __slots__ = ()

    @abstractmethod
    def run(self, call: ServedCall, proceed: Callable[[], Any]) -> Any:
        """Calls ``proceed()``, with its own work before and after. Errors of the service pass through."""

    def rejected(self, call: ServedCall, error: BaseException) -> None:  # noqa: B027 - most have nothing to do then
        """Handles a call that does not begin because its arguments are wrong."""
