"""E-stop messages: orders to stop, confirmations and open e-stops are readable in every protocol version.

That part never changes; docs/wire-protocol.md, "Versions", describes it.
"""

import math
import secrets
from typing import Annotated, Final, TypeVar

import msgspec
from msgspec import Meta, Raw, Struct

from trade.protocol.keys import is_chunk
from trade.protocol.messages import (
    NO_CHUNK,
    UNREADABLE,
    Estop,
    EstopConfirmed,
    EstopOrder,
    Malformed,
    decoded,
    read_any,
)

_LONGEST_REASON: Final = 500
_Value = TypeVar("_Value")


class _AnyEstop(Struct, array_like=True, gc=False):
    """The fields of an e-stop in every version: two, and two more if they can be decoded."""

    id: Annotated[str, Meta(min_length=1, max_length=80)]
    by: Annotated[str, Meta(max_length=300)]
    reason: Raw = Raw()
    at: Raw = Raw()

    def read(self) -> Estop:
        if not is_chunk(self.id):
            raise Malformed(NO_CHUNK)
        at = _if_it_is(_number_decoder, self.at)
        reason = _if_it_is(_text_decoder, self.reason)
        return Estop(self.id, self.by, (reason or "")[:_LONGEST_REASON], at if at and math.isfinite(at) else 0.0)


class _AnyOrder(Struct, array_like=True, gc=False):
    """The fields of an order to stop in every version."""

    v: Annotated[int, Meta(ge=1)]
    request: str
    opened: _AnyEstop | None = None


class _AnyEntry(Struct, gc=False):
    """The fields of an entry with open e-stops in every version."""

    estops: tuple[_AnyEstop, ...] = ()


_order_decoder: Final = msgspec.msgpack.Decoder(EstopOrder)
_confirmed_decoder: Final = msgspec.msgpack.Decoder(EstopConfirmed)
_any_order_decoder: Final = msgspec.msgpack.Decoder(_AnyOrder)
_any_entry_decoder: Final = msgspec.msgpack.Decoder(_AnyEntry)
_text_decoder: Final = msgspec.msgpack.Decoder(str)
_number_decoder: Final = msgspec.msgpack.Decoder(float)


def decode_estop_order(payload: bytes, identity: str) -> EstopOrder:
    """An order of an identity: an order to stop of any version, an order to clear of this one."""
    any_order = read_any(_any_order_decoder, payload)
    if any_order.opened is None:
        order = decoded(_order_decoder, payload)
        if not all(map(is_chunk, (order.request, *order.cleared))):
            raise Malformed(NO_CHUNK)
        return order
    estop = any_order.opened.read()
    if estop.id != any_order.request or not estop.by.startswith(f"{identity}/"):
        raise Malformed(f"e-stop {estop.id!r} of {estop.by!r} is not one of {identity}")
    return EstopOrder(any_order.v, estop.id, estop)


def decode_estop_confirmed(payload: bytes) -> EstopConfirmed:
    """A confirmation of any version."""
    return read_any(_confirmed_decoder, payload)


def decode_open_estops(payload: bytes) -> tuple[Estop, ...]:
    """The open e-stops of a registry entry of any version."""
    return tuple(estop.read() for estop in read_any(_any_entry_decoder, payload).estops)


def _if_it_is(decoder: msgspec.msgpack.Decoder[_Value], raw: Raw) -> _Value | None:
    try:
        return decoder.decode(raw)
    except UNREADABLE:
        return None


def new_estop_id() -> str:
    """A new, unique id."""
    return secrets.token_hex(4)
