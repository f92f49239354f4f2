"""What is around a service while it is called: audit, spans and hooks are interceptors, one inside the other."""

from collections.abc import Sequence
from typing import Any, Protocol

from trade._context.call_context import CallContext
from trade._protocol.messages import ServiceInfo


class ServiceSignature(Protocol):
    """What an interceptor asks of a signature."""

    has_secrets: bool


class ServedService(Protocol):
    """A service of this container, as an interceptor sees it."""

    label: str
    info: ServiceInfo
    effect: str
    around: "Interceptor | None"
    audited: Any

    @property
    def signature(self) -> ServiceSignature: ...

    def call(self, args: Sequence[Any], kwargs: dict[str, Any], context: CallContext, *, bare: bool = False) -> Any:
        """Call it; ``bare``: without interceptors."""
        ...


class Interceptor(Protocol):
    """What is called before and after a service."""

    def run(self, service: Any, args: Sequence[Any], kwargs: dict[str, Any], context: CallContext) -> Any: ...
