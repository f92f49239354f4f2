"""Feetech's protocol: bytes to packets and back. Pure: no port, no clock.

``FF FF | ID | LEN | INST | parameters | CK``; LEN counts what follows it, CK is the inverted sum of all between header
and itself. Independent of the driver's code, so that each can check the other.
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from trade_hil_sim.serial import _packets as packets
from trade_hil_sim.serial._packets import BROADCAST, Reading, Writing

HEADER: Final = b"\xff\xff"
LONGEST: Final = 250
"""The greatest valid LEN, an assumption; more is noise."""


class Instruction(IntEnum):
    """Instruction field; lower-case names are used in logs and fault scripts."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    FACTORY_RESET = 0x06
    REBOOT = 0x08
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83


def checksum(body: bytes) -> int:
    """The check sum of a packet with these bytes after the header."""
    return 0xFF - sum(body) % 256


def encode(device_id: int, instruction: int, params: bytes = b"") -> bytes:
    """Encode one packet."""
    body = bytes([device_id, 2 + len(params), instruction]) + params
    return HEADER + body + bytes([checksum(body)])


def status(device_id: int, complaints: int, params: bytes = b"") -> bytes:
    """One answer; ``complaints`` are the bits of register 65."""
    return encode(device_id, complaints, params)


@dataclass(frozen=True, slots=True)
class Packet(packets.Packet):
    """One packet."""

    names = Instruction

    def readings(self) -> list[Reading]:
        """What a read or sync read asks for; nothing if its parameters make no sense."""
        params = self.params
        match self.instruction:
            case Instruction.READ if len(params) == 2:
                return [Reading(self.device_id, *params)]
            case Instruction.SYNC_READ if len(params) > 2:
                return [Reading(device_id, params[0], params[1]) for device_id in params[2:]]
            case _:
                return []

    def writings(self) -> list[Writing]:
        """What a write, reg write or sync write asks for; nothing if its parameters make no sense."""
        params = self.params
        match self.instruction:
            case Instruction.WRITE | Instruction.REG_WRITE if len(params) > 1:
                return [Writing(self.device_id, params[0], params[1:])]
            case Instruction.SYNC_WRITE if len(params) > 2 and params[1] and not (len(params) - 2) % (params[1] + 1):
                address, size = params[:2]
                starts = range(2, len(params), size + 1)
                return [Writing(params[at], address, params[at + 1 : at + 1 + size]) for at in starts]
            case _:
                return []


class PacketReader(packets.PacketReader[Packet]):
    """Cuts a stream of bytes into packets, wherever the chunks break; what has a wrong checksum is none."""

    def _next(self) -> Packet | None:
        while True:
            at = self._held.find(HEADER)
            self._skip(at if at >= 0 else len(self._held) - self._held.endswith(HEADER[:1]))
            held = self._held
            if len(held) < 4:
                return None
            device_id, length = held[2], held[3]
            if device_id > BROADCAST or not 2 <= length <= LONGEST:
                self._skip(1)
                continue
            if len(held) < 4 + length:
                return None
            packet = held[: 4 + length]
            if checksum(packet[2:-1]) != packet[-1]:
                self._skip(1)
                continue
            self._held = held[4 + length :]
            return Packet(device_id, packet[4], packet[5:-1])
