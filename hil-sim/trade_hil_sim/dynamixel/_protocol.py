"""Dynamixel Protocol 2.0: bytes to packets and back. Pure: no port, no clock.

Source: ROBOTIS e-Manual, "DYNAMIXEL Protocol 2.0". Written from the manual, independent of any client library, so that
the two can check each other.
"""

from dataclasses import dataclass, field
from enum import IntEnum
from typing import Final

from trade_hil_sim.serial import _packets as packets
from trade_hil_sim.serial._packets import BROADCAST, Reading, Writing

HEADER: Final = b"\xff\xff\xfd\x00"
RESYNC: Final = b"\xff\xff\xfd"
STUFFED: Final = b"\xff\xff\xfd\xfd"
HIGHEST_ID: Final = 252
BODY: Final = 7
"""Position of the instruction: header, id and length come before."""
LONGEST: Final = 4096
"""The greatest length of a packet; more is noise. No X-series device accepts as many bytes."""
ALERT: Final = 0x80
"""Bit of a status packet's error field: a hardware error is latched, and register 70 says which."""


class Instruction(IntEnum):
    """Instruction field (e-Manual, "Instruction"); lower-case names are used in logs and fault scripts."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    FACTORY_RESET = 0x06
    REBOOT = 0x08
    CLEAR = 0x10
    CONTROL_TABLE_BACKUP = 0x20
    STATUS = 0x55
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A
    BULK_READ = 0x92
    BULK_WRITE = 0x93
    FAST_BULK_READ = 0x9A


class ErrorCode(IntEnum):
    """Number in a status packet's error field (e-Manual, "Error")."""

    NONE = 0
    RESULT_FAIL = 1
    INSTRUCTION = 2
    CRC = 3
    DATA_RANGE = 4
    DATA_LENGTH = 5
    DATA_LIMIT = 6
    ACCESS = 7


def _crc_table() -> tuple[int, ...]:
    table: list[int] = []
    for high in range(256):
        crc = high << 8
        for _ in range(8):
            crc = (crc << 1) ^ 0x8005 if crc & 0x8000 else crc << 1
        table.append(crc & 0xFFFF)
    return tuple(table)


_CRC: Final = _crc_table()


def crc16(data: bytes, crc: int = 0) -> int:
    """CRC-16 with polynomial 0x8005, not reflected; pass the last result to continue (e-Manual, "CRC Calculation")."""
    for byte in data:
        crc = (crc << 8 & 0xFF00) ^ _CRC[crc >> 8 ^ byte]
    return crc


def stuff(body: bytes) -> bytes:
    """Mark every FF FF FD inside a packet, so that it is not taken for a header."""
    return body.replace(RESYNC, STUFFED)


def unstuff(body: bytes) -> bytes:
    """Reverse `stuff`."""
    return body.replace(STUFFED, RESYNC)


def encode(device_id: int, instruction: int, params: bytes = b"") -> bytes:
    """Encode one packet."""
    body = stuff(bytes([instruction]) + params)
    packet = HEADER + bytes([device_id]) + (len(body) + 2).to_bytes(2, "little") + body
    return packet + crc16(packet).to_bytes(2, "little")


def status(device_id: int, error: int, params: bytes = b"") -> bytes:
    """One answer; `error` is an `ErrorCode`, with 0x80 added while a hardware error is latched."""
    return encode(device_id, Instruction.STATUS, bytes([error]) + params)


@dataclass(frozen=True, slots=True)
class Packet(packets.Packet):
    """One packet, unstuffed."""

    intact: bool = True
    """Whether the CRC was right."""
    names = Instruction

    def readings(self) -> list[Reading]:
        """What a read, sync read or bulk read (fast or not) asks for; nothing if its parameters make no sense."""
        params = self.params
        match self.instruction:
            case Instruction.READ if len(params) == 4:
                return [Reading(self.device_id, _word(params, 0), _word(params, 2))]
            case Instruction.SYNC_READ | Instruction.FAST_SYNC_READ:
                return [Reading(device_id, _word(params, 0), _word(params, 2)) for device_id in params[4:]]
            case Instruction.BULK_READ | Instruction.FAST_BULK_READ if len(params) % 5 == 0:
                starts = range(0, len(params), 5)
                return [Reading(params[i], _word(params, i + 1), _word(params, i + 3)) for i in starts]
            case _:
                return []

    def writings(self) -> list[Writing]:
        """What a write, reg write, sync write or bulk write asks for; nothing if its parameters make no sense."""
        params = self.params
        match self.instruction:
            case Instruction.WRITE | Instruction.REG_WRITE if len(params) > 2:
                return [Writing(self.device_id, _word(params, 0), params[2:])]
            case Instruction.SYNC_WRITE:
                return _sync_writings(params)
            case Instruction.BULK_WRITE:
                return _bulk_writings(params)
            case _:
                return []


def _sync_writings(params: bytes) -> list[Writing]:
    address, size, rest = _word(params, 0), _word(params, 2), params[4:]
    if size == 0 or len(rest) % (size + 1):
        return []
    return [Writing(rest[i], address, rest[i + 1 : i + 1 + size]) for i in range(0, len(rest), size + 1)]


def _bulk_writings(params: bytes) -> list[Writing]:
    found: list[Writing] = []
    while params:
        size = _word(params, 3) if len(params) >= 5 else 0
        if size == 0 or len(params) < 5 + size:
            return []
        found.append(Writing(params[0], _word(params, 1), params[5 : 5 + size]))
        params = params[5 + size :]
    return found


def _word(params: bytes, at: int) -> int:
    return int.from_bytes(params[at : at + 2], "little")


class PacketReader(packets.PacketReader[Packet]):
    """Cuts a stream of bytes into packets, wherever the chunks break.

    Strict like a device: a header inside a packet that is not stuffed begins a new one, so what a client sends without
    stuffing is lost, not guessed at.
    """

    def _next(self) -> Packet | None:
        while True:
            self._skip(_header_at(self._held))
            held = self._held
            if len(held) < BODY:
                return None
            length = int.from_bytes(held[5:7], "little")
            if not _plausible(held[4], length):
                self._skip(1)
                continue
            if (inner := _inner_header(held, BODY + length - 2)) is not None:
                self._skip(inner)
                continue
            if len(held) < BODY + length:
                return None
            self._held = held[BODY + length :]
            return _decoded(held[: BODY + length])


def _header_at(held: bytes) -> int:
    """Where the first header begins; a partial header at the end is kept."""
    at = held.find(HEADER)
    if at >= 0:
        return at
    kept = next((n for n in (3, 2, 1) if held.endswith(HEADER[:n])), 0)
    return len(held) - kept


def _plausible(device_id: int, length: int) -> bool:
    return (device_id <= HIGHEST_ID or device_id == BROADCAST) and 3 <= length <= LONGEST


def _inner_header(held: bytes, end: int) -> int | None:
    at = held.find(RESYNC, BODY, end)
    while at >= 0:
        after = at + len(RESYNC)
        if after < end and after >= len(held):
            return None  # the byte that decides has not arrived yet
        if after >= end or held[after] != RESYNC[-1]:
            return at
        at = held.find(RESYNC, after + 1, end)
    return None


def _decoded(raw: bytes) -> Packet:
    body = unstuff(raw[BODY:-2])
    intact = crc16(raw[:-2]) == int.from_bytes(raw[-2:], "little")
    return Packet(raw[4], body[0], body[1:], intact)


@dataclass(slots=True)
class JoinedStatus:
    """The one answer of all devices to a fast sync or fast bulk read: each adds its block behind the one before.

    A block ends with the CRC of everything before it. Nothing is stuffed: neither vendor client unstuffs this answer.
    """

    data_bytes: int
    """How many bytes of data all blocks together will hold."""
    blocks: int
    _packet: bytearray = field(default_factory=bytearray)

    def __post_init__(self) -> None:
        length = 1 + self.data_bytes + 4 * self.blocks
        self._packet += HEADER + bytes([BROADCAST]) + length.to_bytes(2, "little") + bytes([Instruction.STATUS])

    def add(self, device_id: int, error: int, data: bytes) -> None:
        """Append one device's block."""
        self._packet += bytes([error, device_id]) + data
        self._packet += crc16(bytes(self._packet)).to_bytes(2, "little")

    def __bytes__(self) -> bytes:
        return bytes(self._packet)
