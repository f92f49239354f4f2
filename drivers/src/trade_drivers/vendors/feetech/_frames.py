"""The packets of SCS and STS servos: bytes in, packets out; no I/O and no clock.

``FF FF | ID | LEN | INST | parameters | CK``; LEN counts from INST on, CK is the inverted sum of all between header and
itself. An answer has the device's status in place of INST. Nothing is stuffed: a header may stand in the parameters.
"""

from collections.abc import Container
from typing import Final, NamedTuple

__all__ = ["Corrupt", "Instruction", "Status", "checksum", "packet", "take_status"]

HEADER: Final = b"\xff\xff"
OVERHEAD: Final = 6
"""Bytes of a packet without parameters."""
_ID, _LENGTH, _STATUS = 2, 3, 4
_BEFORE_PARAMETERS: Final = 5


class Instruction:
    """What this driver asks for."""

    READ: Final = 0x02
    WRITE: Final = 0x03
    SYNC_READ: Final = 0x82
    SYNC_WRITE: Final = 0x83


class Corrupt(Exception):
    """An answer of the right kind arrived whose checksum is wrong."""


class Status(NamedTuple):
    """One answer."""

    device_id: int
    status: int
    """Bits of what the device complains of; the instruction was carried out all the same."""
    data: bytes


def checksum(body: bytes) -> int:
    """The last byte of a packet, over all between its header and itself."""
    return ~sum(body) & 0xFF


def packet(device_id: int, instruction: int, parameters: bytes = b"") -> bytes:
    """One packet as it goes over the wire."""
    body = bytes((device_id, len(parameters) + 2, instruction)) + parameters
    return HEADER + body + bytes((checksum(body),))


def take_status(buffer: bytearray, ids: Container[int], size: int, sent: bytes = b"") -> Status | None:
    """The first whole answer of one of these devices with so many bytes of data; None while it is incomplete.

    It is taken out of the buffer with all that comes before it: noise, answers of another length, and what was sent,
    where the adapter echoes.

    Raises:
        Corrupt: an answer with a wrong checksum was taken out.
    """
    whole = OVERHEAD + size
    while True:
        start = buffer.find(HEADER)
        if start < 0:
            del buffer[: max(0, len(buffer) - 1)]  # half a header may stand at the end
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
        del buffer[0]  # noise that looks like a header: the answer is still to come
