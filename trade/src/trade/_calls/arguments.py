"""The caller's half of a call: its arguments as bytes, or why they cannot be sent."""

# pyright: reportUnknownVariableType=false

from collections.abc import Mapping
from typing import Any

from msgspec import structs

from trade._protocol.codec import Codec
from trade._protocol.messages import EMPTY, MOST_BYTES, Call, ServiceInfo, encode_message
from trade._services.signature import too_many
from trade.errors import InvalidArgument, NotSerialisable, TooLarge

__all__ = ["encode_arguments", "encode_call", "given"]


def encode_arguments(
    codec: Codec, info: ServiceInfo, service: str, args: tuple[Any, ...], kwargs: Mapping[str, Any]
) -> bytes:
    """Positional ones as an array, with keywords as a map of all by name.

    Raises InvalidArgument, NotSerialisable, TooLarge.
    """
    values: Any = args if not kwargs else _by_name(info, service, args, kwargs)
    try:
        data = codec.encode(values)
    except (TypeError, ValueError, OverflowError, RecursionError) as bad:
        raise _unsendable(codec, info, service, values, bad) from None
    if len(data) > MOST_BYTES:
        raise _too_large(service, len(data))
    return data


def given(info: ServiceInfo, service: str, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> Any:
    """Arguments as a message has them. Raises InvalidArgument."""
    return args if not kwargs else _by_name(info, service, args, kwargs)


def encode_call(codec: Codec, info: ServiceInfo, service: str, call: Call) -> bytes:
    """A whole message with the arguments as values in it: large ones are copied once, not twice.

    Raises NotSerialisable, TooLarge.
    """
    values: Any = call.args
    try:
        data = codec.encode(call)
    except (TypeError, ValueError, OverflowError, RecursionError) as bad:
        raise _unsendable(codec, info, service, values, bad) from None
    if len(data) > MOST_BYTES:
        frame = len(encode_message(structs.replace(call, args=EMPTY))) - len(memoryview(EMPTY))
        if len(data) - frame > MOST_BYTES:
            raise _too_large(service, len(data) - frame)
    return data


def _too_large(service: str, size: int) -> TooLarge:
    return TooLarge(service=service, what="arguments", size_bytes=size, limit_bytes=MOST_BYTES)


def _by_name(info: ServiceInfo, service: str, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> dict[str, Any]:
    places = [parameter.name for parameter in info.parameters if not parameter.keyword_only]
    if len(args) > len(places):
        problem = too_many(len(places), len(args))
        raise InvalidArgument(service=service, argument="", problem=problem, signature=info.signature)
    named = dict(zip(places, args, strict=False))
    for name in kwargs:
        if name in named:
            raise InvalidArgument(service=service, argument=name, problem="given twice", signature=info.signature)
    return {**named, **kwargs}


def _unsendable(codec: Codec, info: ServiceInfo, service: str, values: Any, bad: Exception) -> NotSerialisable:
    names = [parameter.name for parameter in info.parameters]
    named: Any = (
        values if isinstance(values, dict) else dict(zip([*names, *map(str, range(len(values)))], values, strict=False))
    )
    for name, value in named.items():
        try:
            codec.encode(value)
        except (TypeError, ValueError, OverflowError, RecursionError) as own:
            return NotSerialisable(service=service, what=f"argument {name!r}", problem=str(own))
    return NotSerialisable(service=service, what="the arguments", problem=str(bad))
