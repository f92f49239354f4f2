"""The caller's half of a call: its arguments as bytes, or why they cannot be sent."""

from collections.abc import Mapping
from typing import Any

from trade._codec import Codec
from trade._wire import MOST_BYTES, ServiceInfo
from trade.errors import InvalidArgument, NotSerialisable, TooLarge

__all__ = ["encode_arguments", "too_many"]


def encode_arguments(
    codec: Codec, info: ServiceInfo, service: str, args: tuple[Any, ...], kwargs: Mapping[str, Any]
) -> bytes:
    """Positional ones as an array, with keywords as a map of all by name.

    Raises InvalidArgument, NotSerialisable, TooLarge.
    """
    try:
        data = codec.encode(args if not kwargs else _by_name(info, service, args, kwargs))
    except (TypeError, ValueError, OverflowError, RecursionError) as bad:
        if isinstance(bad, InvalidArgument):
            raise
        raise _unsendable(codec, info, service, args, kwargs, bad) from None
    if len(data) > MOST_BYTES:
        raise TooLarge(service=service, what="arguments", size_bytes=len(data), limit_bytes=MOST_BYTES)
    return data


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


def too_many(places: int, given: int) -> str:
    return f"takes at most {places} positional argument{'' if places == 1 else 's'}, got {given}"


def _unsendable(
    codec: Codec,
    info: ServiceInfo,
    service: str,
    args: tuple[Any, ...],
    kwargs: Mapping[str, Any],
    bad: Exception,
) -> NotSerialisable:
    names = [parameter.name for parameter in info.parameters]
    every = [*zip([*names, *map(str, range(len(args)))], args, strict=False), *kwargs.items()]
    for name, value in every:
        try:
            codec.encode(value)
        except (TypeError, ValueError, OverflowError, RecursionError) as own:
            return NotSerialisable(service=service, what=f"argument {name!r}", problem=str(own))
    return NotSerialisable(service=service, what="the arguments", problem=str(bad))
