"""Instruction packets for servos, as far as protocols agree: which registers they read and write. Pure."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from enum import IntEnum
from typing import ClassVar, Final, Generic, NamedTuple, TypeVar

BROADCAST: Final = 254
"""The id of all devices."""


class Reading(NamedTuple):
    """Read `length` bytes from `address` of one device."""

    device_id: int
    address: int
    length: int


class Writing(NamedTuple):
    """Write `data` to `address` of one device."""

    device_id: int
    address: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Packet(ABC):
    """One packet."""

    device_id: int
    instruction: int
    params: bytes
    names: ClassVar[type[IntEnum]]

    @property
    def name(self) -> str:
        """Lower-case name of the instruction, or its number in hex."""
        try:
            return self.names(self.instruction).name.lower()
        except ValueError:
            return f"{self.instruction:#04x}"

    @abstractmethod
    def readings(self) -> list[Reading]:
        """The reads that it requests; none if it reads nothing or its parameters are invalid."""

    @abstractmethod
    def writings(self) -> list[Writing]:
        """The writes that it requests; none if it writes nothing or its parameters are invalid."""


_Packet = TypeVar("_Packet", bound=Packet)


class PacketReader(ABC, Generic[_Packet]):
    """Cuts a stream of bytes into packets, independent of the chunks."""

    def __init__(self) -> None:
        self._held = b""
        self.skipped = 0
        """Bytes discarded so far because they belonged to no packet."""

    def feed(self, data: bytes) -> list[_Packet]:
        """Add bytes; return the packets that they complete."""
        self._held += data
        packets: list[_Packet] = []
        while (packet := self._next()) is not None:
            packets.append(packet)
        return packets

    def reset(self) -> None:
        """Discard a partial packet."""
        self._skip(len(self._held))

    @abstractmethod
    def _next(self) -> _Packet | None:
        """Take the next packet from the buffer; None if it is not complete yet."""

    def _skip(self, count: int) -> None:
        self._held = self._held[count:]
        self.skipped += count
