"""How handles travel among values: as the key of their service, in a MessagePack extension of their own."""

import operator
from collections.abc import Callable
from typing import Any, Final

import msgspec

from trade._calls.handle import Handle
from trade._protocol.codec import Codec
from trade._protocol.keys import ServiceKey
from trade._protocol.messages import encode_message

HANDLE_EXT: Final = 1
"""The number of the extension."""


def handle_codec(key_of: Callable[[Handle], ServiceKey], handle_of: Callable[[ServiceKey], Handle]) -> Codec:
    """What turns values into bytes and back.

    Args:
        key_of: what is written of a handle; raises TypeError if it must not leave.
        handle_of: the handle that a key means here; raises msgspec.ValidationError if it means none.
    """

    def to_data(value: Any) -> Any:
        if isinstance(value, Handle):
            return msgspec.msgpack.Ext(HANDLE_EXT, encode_message(key_of(value)))
        if isinstance(value, float):  # of a kind of its own, as those of arrays
            return float(value)
        if hasattr(value, "__index__"):
            return operator.index(value)
        hint = "; send value.tolist()" if hasattr(value, "tolist") else ""
        raise TypeError(f"{type(value).__qualname__} is no plain data{hint}")

    def from_data(code: int, data: memoryview) -> Any:
        if code != HANDLE_EXT:
            raise msgspec.ValidationError(f"Unknown extension {code}")
        return handle_of(msgspec.msgpack.decode(data, type=ServiceKey))

    return Codec(to_data, from_data, (Handle,))
