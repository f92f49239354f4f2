"""Secret arguments: they reach only the provider, and are masked wherever a text might show them."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Final, TypeVar, cast, get_args

import msgspec
from msgspec import Meta, Raw, structs

from trade.protocol.messages import UNREADABLE, ErrorInfo

# Masked values have no types: they came over the wire.
# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false

MASK: Final = "***"
_T = TypeVar("_T")
_NOTE: Final = Meta(extra_json_schema={"writeOnly": True})

Secret = Annotated[_T, _NOTE]
"""Marks an argument as secret: ``Secret[str]``. Its value appears in no error, traceback, log or description."""


def is_secret(type_: Any) -> bool:
    """Whether a parameter's annotation marks it as secret, in whatever form it is written."""
    if any(note is _NOTE for note in getattr(type_, "__metadata__", ())):
        return True
    return any(map(is_secret, get_args(type_)))


def mask(info: ErrorInfo, raw: Raw | bytes, names: Sequence[str], secrets: frozenset[str]) -> ErrorInfo:
    """Replaces the values of secret arguments in an error.

    Args:
        info: the error as it would be sent.
        raw: the arguments of the call.
        names: the names of the service's positional parameters, in order.
        secrets: the ones to mask.
    """
    named = _named(raw, names)
    try:
        texts = {form for name in secrets if name in named for value in _leaves(named[name]) for form in _forms(value)}
        ordered = sorted(texts, key=len, reverse=True)
        return structs.replace(
            info,
            message=_masked(info.message, ordered),
            fields=_masked(info.fields, ordered),
            traceback=_masked(info.traceback, ordered),
        )
    except RecursionError:  # nested too deeply to search
        return structs.replace(info, message=MASK, fields={}, traceback="")


def _named(raw: Raw | bytes, names: Sequence[str]) -> Mapping[str, Any]:
    """The arguments by name; empty if the message has no valid arguments: no provider has seen a value then."""
    try:
        given: Any = msgspec.msgpack.decode(raw)
    except UNREADABLE:
        return {}
    match given:
        case dict():
            return cast("dict[str, Any]", given)
        case list():
            return dict(zip(names, cast("list[Any]", given), strict=False))
        case _:
            return {}


def _leaves(value: Any) -> Iterator[Any]:
    if isinstance(value, Mapping):
        for inner in value.values():
            yield from _leaves(inner)
    elif isinstance(value, list | tuple):
        for inner in value:
            yield from _leaves(inner)
    elif value is not None and not isinstance(value, bool):
        yield value


def _forms(value: Any) -> Iterator[str]:
    """The forms in which a value may appear in a text."""
    for text in (str(value), repr(value), repr(value)[1:-1] if isinstance(value, str) else ""):
        if text:
            yield text
    if isinstance(value, bytes):
        yield value.hex()
        yield value.decode(errors="backslashreplace")
        yield repr(value)[2:-1]


def _masked(value: Any, texts: Sequence[str]) -> Any:
    if isinstance(value, str):
        for text in texts:
            if text:
                value = value.replace(text, MASK)
        return value
    if isinstance(value, Mapping):
        return {name: _masked(inner, texts) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_masked(inner, texts) for inner in value]
    return MASK if value is not None and not isinstance(value, bool) and str(value) in texts else value
