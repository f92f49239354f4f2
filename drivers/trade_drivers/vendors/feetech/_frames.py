"""Encodes and decodes the packets of SCS and STS servos, without I/O and without a clock.

``FF FF | ID | LEN | INST | parameters | CK``. LEN is the number of bytes from INST on. CK is the inverted sum of the
bytes between header and CK. An answer has the device's status in place of INST. There is no byte stuffing, so the
parameters may contain the bytes of a header.
"""

from collections.abc import Container
from typing import Final, NamedTuple

HEADER: Final = b"\xff\xff"
OVERHEAD: Final = 6
"""Bytes of a packet without parameters."""
_ID, _LENGTH, _STATUS = 2, 3, 4
_BEFORE_PARAMETERS: Final = 5


class Instruction:
    """The instructions that this driver sends."""

    READ: Final = 0x02
    WRITE: Final = 0x03
    SYNC_READ: Final = 0x82
    SYNC_WRITE: Final = 0x83


class Corrupt(Exception):
    """The checksum of an answer is wrong."""


class Status(NamedTuple):
    """One answer."""

    device_id: int
    status: int
    """Error bits of the device; it carries out the instruction nevertheless."""
    data: bytes


def checksum(body: bytes) -> int:
    """The checksum of the bytes between the header and the checksum."""
    return ~sum(body) & 0xFF


def packet(device_id: int, instruction: int, parameters: bytes = b"") -> bytes:
    """Encodes one packet."""
    body = bytes((device_id, len(parameters) + 2, instruction)) + parameters
    return HEADER + body + bytes((checksum(body),))


def take_status(buffer: bytearray, ids: Container[int], size: int, sent: bytes = b"") -> Status | None:
    """Removes the first answer of these devices with ``size`` bytes of data from the buffer; None if it is incomplete.

    All bytes before the answer are removed, too: noise, answers of another length, and the request if the adapter
    echoes it.

    Raises:
        Corrupt: an answer with a wrong checksum was removed.
    """
    whole = OVERHEAD + size
    while True:
        start = buffer.find(HEADER)
        if start < 0:
            del buffer[: max(0, len(buffer) - 1)]  # the buffer may end with half a header
            return None
        del buffer[:start]
        if len(buffer) <= _LENGTH:
            return None
        if buffer[_ID] not in ids or buffer[_LENGTH] != size + 2:
            del buffer[0]
            continue
        if len(buffer) < whole:
            return None
        frame = bytes(buffer[:whole])
        if checksum(frame[_ID:-1]) == frame[-1]:
            del buffer[:whole]
            if frame == sent:
                continue
            return Status(frame[_ID], frame[_STATUS], frame[_BEFORE_PARAMETERS:-1])
        behind = buffer[whole : whole + len(HEADER)]
        if HEADER.startswith(behind):
            del buffer[:whole]
            raise Corrupt
        del buffer[0]  # noise that looks like a header: the answer follows
