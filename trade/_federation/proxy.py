"""A proxy for a service of another system: it forwards each call, and returns the answer unchanged."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Any, Final

from msgspec import Raw

from trade._calls.handle import LONGEST_DEADLINE_S, Handle
from trade._context.call_context import CallContext, current_call
from trade._resources.resource import Resource
from trade._services.decorator import Effect, ServiceMark
from trade._services.event_loop import AsyncLoop
from trade._services.local_service import LocalService
from trade._services.signature import Signature
from trade.errors import InvalidArgument, NotSerialisable, TooLarge
from trade.protocol.codec import Codec
from trade.protocol.messages import MOST_BYTES, UNREADABLE, ErrorInfo, ServiceInfo
from trade.protocol.remote_errors import passed_on
from trade.protocol.schema import read_schema

_AT_LEAST_S: Final = 0.001
"""The shortest deadline of a forwarded call: the home refuses expired calls, as it does all others."""

Speaking = Callable[[CallContext], AbstractContextManager[None]]
"""A context in which calls in the other system are made on behalf of a call here."""


class _ProxyMethod(Signature):
    """A signature that translates handles and checks nothing, because the service's own container checks."""

    def __init__(self, info: ServiceInfo, codec: Codec) -> None:
        self.info = info
        self._codec = codec
        self._plain = codec.decoder(Any)
        self._result_is_plain = Any
        self._positional = [parameter.name for parameter in info.parameters if not parameter.keyword_only]
        properties: dict[str, Any] = read_schema(info.arguments_schema).get("properties", {})
        self._secrets = frozenset(name for name, schema in properties.items() if schema.get("writeOnly"))
        self.has_secrets = False  # its home has removed secrets from errors

    def decode(self, service: str, raw: Raw | bytes) -> tuple[Sequence[Any], dict[str, Any]]:
        try:
            given = self._plain(raw)
        except UNREADABLE as bad:
            raise self._refused(service, str(bad)) from None
        if isinstance(given, list):
            return given, {}  # pyright: ignore[reportUnknownVariableType]
        if isinstance(given, dict) and all(isinstance(name, str) for name in given):  # pyright: ignore[reportUnknownVariableType]
            return (), given  # pyright: ignore[reportUnknownVariableType]
        raise self._refused(service, "neither a list of arguments nor arguments by name")

    def _refused(self, service: str, problem: str) -> InvalidArgument:
        return InvalidArgument(service=service, argument="", problem=problem, signature=self.info.signature)

    def encode_result(self, service: str, value: Any) -> bytes:
        return self._encoded(service, value, "its result")

    def copy_result(self, service: str, value: Any) -> Any:
        return self._plain(self.encode_result(service, value))

    def encode_progress(self, service: str, value: Any) -> bytes:
        return self._encoded(service, value, "its progress")

    def copy_progress(self, service: str, value: Any) -> Any:
        return self._plain(self.encode_progress(service, value))

    def _encoded(self, service: str, value: Any, what: str) -> bytes:
        try:
            data = self._codec.encode(value)
        except (TypeError, ValueError, OverflowError, RecursionError) as bad:
            raise NotSerialisable(service=service, what=what, problem=str(bad)) from None
        if len(data) > MOST_BYTES:
            raise TooLarge(service=service, what=what, size_bytes=len(data), limit_bytes=MOST_BYTES)
        return data


class ProxyProvider(LocalService):
    """A service of this container whose home is another system."""

    __slots__ = ()

    def failure(self, error: BaseException, raw: Raw | bytes) -> ErrorInfo:  # noqa: ARG002 - masked at home
        return passed_on(error)


def passed_on_service(
    label: str,
    info: ServiceInfo,
    home: Handle,
    speaking: Speaking,
    codec: Codec,
    resources: tuple[Resource, ...],
    loop: AsyncLoop,
) -> ProxyProvider:
    """A proxy for a service, called through a handle in its own system.

    Args:
        label: its name in errors.
        info: its description.
        home: the service itself.
        speaking: makes calls there on behalf of the caller here.
        codec: translates handles from this system to that one and back.
        resources: what it needs exclusively, or what locks of it hold.
        loop: the event loop of its container.
    """

    def forward(*args: Any, **kwargs: Any) -> Any:
        call = current_call()
        assert call is not None  # noqa: S101 - it is only called as a service
        left_s = call.remaining_s
        aimed = home if left_s is None else home.with_(deadline_s=min(max(left_s, _AT_LEAST_S), LONGEST_DEADLINE_S))
        with speaking(call):
            run = aimed.start(*args, **kwargs)
        run.on_progress(call.progress)
        call.on_cancel(run.ask_to_end)
        return run.result()

    mark = ServiceMark(effect=_effect(info.effect), cancel=info.cancel)
    return ProxyProvider(label, info, _ProxyMethod(info, codec), forward, mark, loop, None, resources)


def _effect(named: str) -> Effect:
    """The effect of that name; an unknown one counts as the effect that needs most rights."""
    known: dict[str, Effect] = {"read": "read", "note": "note", "stop": "stop"}
    return known.get(named, "actuate")
