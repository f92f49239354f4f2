"""The encoder of a call's arguments, on the caller's side."""

# pyright: reportUnknownVariableType=false

from collections.abc import Mapping
from typing import Any, Final

from msgspec import structs

from trade._services.signature import too_many
from trade.errors import InvalidArgument, NotSerialisable, TooLarge
from trade.protocol.codec import Codec
from trade.protocol.messages import EMPTY, LARGE, MOST_BYTES, Call, LargeBytes, ServiceInfo, encode_message

_UNSENDABLE: Final = (TypeError, ValueError, OverflowError, RecursionError)

_EMPTY_BYTES: Final = len(encode_message(b""))


class ArgumentEncoder:
    """Encodes the arguments of one service. Raises InvalidArgument, NotSerialisable, TooLarge."""

    __slots__ = ("_codec", "_info", "_label")

    def __init__(self, codec: Codec, info: ServiceInfo, label: str) -> None:
        self._codec = codec
        self._info = info
        self._label = label

    def values(self, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> Any:
        """Arguments in the form of the message: an array if all are positional, else a map by name."""
        return args if not kwargs else self._by_name(args, kwargs)

    def encode(self, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> bytes:
        """The arguments as bytes, with their present values."""
        values: Any = args if not kwargs else self._by_name(args, kwargs)
        try:
            data = self._codec.encode(values)
        except _UNSENDABLE as bad:
            raise self._unsendable(values, bad) from None
        if len(data) > MOST_BYTES:
            raise self._too_large(len(data))
        return data

    def encode_call(self, call: Call) -> bytes:
        """A whole message with its arguments, so that large ones are copied once, not twice."""
        try:
            data = self._codec.encode(call)
        except _UNSENDABLE as bad:
            raise self._unsendable(call.args, bad) from None
        if len(data) > MOST_BYTES:
            frame = len(encode_message(structs.replace(call, args=EMPTY))) - len(memoryview(EMPTY))
            if len(data) - frame > MOST_BYTES:
                raise self._too_large(len(data) - frame)
        return data

    def encode_parts(self, call: Call) -> tuple[bytes, ...]:
        """The same in parts. If the last argument is large bytes, it is a part itself and not copied."""
        args: Any = call.args
        values: tuple[Any, ...] = args if type(args) is tuple else ()
        last = values[-1] if values else None
        if type(last) is not bytes or len(last) < LARGE:
            return (self.encode_call(call),)
        data, large = self.encode_call(structs.replace(call, args=(*values[:-1], b""))), LargeBytes(last)
        if len(data) + len(last) > MOST_BYTES:
            return (self.encode_call(call),)  # which looks at the limit more closely
        end = len(data) - len(encode_message(call.behalf))
        return data[: end - _EMPTY_BYTES] + large.head, last, data[end:]

    def _too_large(self, size: int) -> TooLarge:
        return TooLarge(service=self._label, what="arguments", size_bytes=size, limit_bytes=MOST_BYTES)

    def _by_name(self, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> dict[str, Any]:
        places = [parameter.name for parameter in self._info.parameters if not parameter.keyword_only]
        if len(args) > len(places):
            raise self._invalid("", too_many(len(places), len(args)))
        named = dict(zip(places, args, strict=False))
        for name in kwargs:
            if name in named:
                raise self._invalid(name, "given twice")
        return {**named, **kwargs}

    def _invalid(self, argument: str, problem: str) -> InvalidArgument:
        return InvalidArgument(service=self._label, argument=argument, problem=problem, signature=self._info.signature)

    def _unsendable(self, values: Any, bad: Exception) -> NotSerialisable:
        names = [parameter.name for parameter in self._info.parameters]
        places = [*names, *map(str, range(len(values)))]
        named: Any = values if isinstance(values, dict) else dict(zip(places, values, strict=False))
        for name, value in named.items():
            try:
                self._codec.encode(value)
            except _UNSENDABLE as own:
                return NotSerialisable(service=self._label, what=f"argument {name!r}", problem=str(own))
        return NotSerialisable(service=self._label, what="the arguments", problem=str(bad))
