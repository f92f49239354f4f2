"""Decoding of protocol 2.0 status packets. No I/O and no clock.

Source: ROBOTIS e-Manual, "DYNAMIXEL Protocol 2.0": ``FF FF FD 00 | ID | LEN16 | 55 | ERR | parameters | CRC16``.
"""

from collections.abc import Iterable
from typing import Final

HEADER: Final = b"\xff\xff\xfd"
STUFFED: Final = b"\xff\xff\xfd\xfd"
STATUS: Final = 0x55
OVERHEAD: Final = 11
"""Bytes of a status packet without parameters."""
_PREFIX: Final = 7
_LONGEST: Final = 1024


class Corrupt(Exception):
    """The CRC of a packet is wrong."""


def _table() -> tuple[int, ...]:
    entries: list[int] = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = ((crc << 1) ^ 0x8005 if crc & 0x8000 else crc << 1) & 0xFFFF
        entries.append(crc)
    return tuple(entries)


_CRC: Final = _table()


def crc16(data: Iterable[int], crc: int = 0) -> int:
    """Returns the CRC-16 with polynomial 0x8005, start value 0 and no reflection, as the e-Manual defines it."""
    table = _CRC
    for byte in data:
        crc = ((crc << 8) & 0xFFFF) ^ table[(crc >> 8) ^ byte]
    return crc


def take_status(buffer: bytearray) -> bytes | None:
    """Removes the first complete status packet, and noise before it, from the buffer; None while it is incomplete.

    Raises:
        Corrupt: a packet with a wrong CRC was removed.
    """
    while True:
        start = buffer.find(HEADER)
        if start < 0:
            del buffer[: max(0, len(buffer) - 2)]  # the end may be a partial header
            return None
        if start:
            del buffer[:start]
        if len(buffer) <= _PREFIX:
            return None
        length = buffer[5] | buffer[6] << 8
        if buffer[3] != 0 or buffer[_PREFIX] != STATUS or not OVERHEAD - _PREFIX <= length <= _LONGEST:
            del buffer[0]  # an instruction's echo, or noise that looks like a header
            continue
        end = _PREFIX + length
        if len(buffer) < end:
            return None
        frame = bytes(buffer[:end])
        del buffer[:end]
        if crc16(frame[:-2]) != frame[-2] | frame[-1] << 8:
            raise Corrupt
        return frame


def unstuffed(frame: bytes) -> bytes:
    """Returns the packet without the stuffing bytes that keep headers out of its parameters."""
    if STUFFED not in frame[_PREFIX:-2]:
        return frame
    return frame[:_PREFIX] + frame[_PREFIX:-2].replace(STUFFED, HEADER) + frame[-2:]
