"""What is around a service while it is called: a list of interceptors, the outermost first.

Audit comes first and sees what the others do; then spans, then hooks. Each calls the next one, and the last of them
the service.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

from trade._context.call_context import CallContext
from trade._protocol.messages import ServiceInfo


class ServiceSignature(Protocol):
    """What an interceptor asks of a signature."""

    has_secrets: bool

    def named(self, args: Sequence[Any], kwargs: Mapping[str, Any]) -> dict[str, Any]: ...


class ServedService(Protocol):
    """A service of this container, as an interceptor sees it."""

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


class Interceptor(ABC):
    """What is called in place of a service, with what calls that: ``proceed()``."""

    __slots__ = ()

    @abstractmethod
    def run(self, call: ServedCall, proceed: Callable[[], Any]) -> Any:
        """Call what is inside, and do what comes before and after that. Errors of the service pass."""

    def rejected(self, call: ServedCall, error: BaseException) -> None:  # noqa: B027 - most have nothing to do then
        """A call does not begin: its arguments, which it has not, are wrong."""
