"""RTDE packets: a size, a type, a payload. Pure; fields are packed as a recipe lists them."""

import struct
from collections.abc import Iterator, Mapping, Sequence
from enum import IntEnum
from typing import Final, NamedTuple

from ._table import TYPES

_HEAD: Final = struct.Struct(">HB")
LONGEST: Final = 65_535
"""The greatest length of a packet."""
MOST_PAYLOAD: Final = LONGEST - _HEAD.size

Value = float | int | bool | Sequence[float] | Sequence[int]


class PacketType(IntEnum):
    """The second field of every packet."""

    PROTOCOL = ord("V")
    VERSION = ord("v")
    MESSAGE = ord("M")
    DATA = ord("U")
    OUTPUTS = ord("O")
    INPUTS = ord("I")
    START = ord("S")
    PAUSE = ord("P")


class Packet(NamedTuple):
    """One packet."""

    kind: int
    payload: bytes = b""

    def encode(self) -> bytes:
        """The packet as bytes on the wire."""
        return _HEAD.pack(_HEAD.size + len(self.payload), self.kind) + self.payload


def frames(held: bytearray) -> Iterator[Packet]:
    """Take the complete packets from the buffer; an incomplete one stays.

    Raises:
        ValueError: a size below that of the head, so what follows is lost.
    """
    while len(held) >= _HEAD.size:
        size, kind = _HEAD.unpack_from(held)
        if size < _HEAD.size:
            raise ValueError(f"a packet of {size} bytes")
        if len(held) < size:
            return
        payload = bytes(held[_HEAD.size : size])
        del held[:size]
        yield Packet(kind, payload)


def names_in(payload: bytes) -> list[str]:
    """The names in a list separated by commas; a comma at its end adds none."""
    return [name for name in payload.decode("ascii", "replace").split(",") if name]


class Recipe:
    """Fields that are sent together.

    Args:
        names: of the fields, in order.
        types: of all fields there are.
    """

    def __init__(self, names: Sequence[str], types: Mapping[str, str]) -> None:
        self.names = tuple(names)
        self._struct = struct.Struct(">" + "".join(TYPES[types[name]] for name in names))
        self._counts = [int(TYPES[types[name]][:-1] or 1) for name in names]

    def pack(self, values: Mapping[str, Value]) -> bytes:
        """The fields of a data packet."""
        flat: list[float | int] = []
        for name in self.names:
            value = values[name]
            if isinstance(value, int | float):
                flat.append(value)
            else:
                flat.extend(value)
        return self._struct.pack(*flat)

    def unpack(self, data: bytes) -> dict[str, Value]:
        """The fields by name; what comes after them is ignored: ur-rtde sends more in its getForwardKinematics.

        Raises:
            ValueError: too few bytes.
        """
        if len(data) < self._struct.size:
            raise ValueError(f"{len(data)} bytes for a recipe of {self._struct.size}")
        flat, found, at = self._struct.unpack_from(data), dict[str, Value](), 0
        for name, count in zip(self.names, self._counts, strict=True):
            found[name] = flat[at] if count == 1 else flat[at : at + count]
            at += count
        return found
