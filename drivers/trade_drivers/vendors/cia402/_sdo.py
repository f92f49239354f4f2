"""SDO transfers, frame by frame (CiA 301, 7.2.4). Pure."""

import struct
from collections.abc import Generator
from typing import Final, NamedTuple

_SIZE: Final = 8
_EXPEDITED: Final = 4
"""Maximum size in the first frame; this driver writes nothing longer."""
_MOST_SEGMENTS: Final = 37
"""Maximum segments of a text: 259 bytes, or fewer if the drive's segments are not full."""
_DOWNLOAD, _UPLOAD, _SEGMENT, _ABORT = 0x20, 0x40, 0x60, 0x80
_COMMAND: Final = 0xE0
_TOGGLE: Final = 0x10
_ANSWERS: Final = {_DOWNLOAD: 0x60, _UPLOAD: 0x40}
TIMED_OUT: Final = 0x05040000
"""Abort code of a transfer."""


class Aborted(Exception):
    """The drive aborted the transfer, with a code."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


class Request(NamedTuple):
    """One frame to a drive."""

    data: bytes
    address: bytes
    """The object: index and sub-index."""

    def is_answered_by(self, frame: bytes) -> bool:
        """Returns whether a frame answers or aborts this request; other frames are late or noise."""
        if len(frame) != _SIZE:
            return False
        if frame[0] == _ABORT:
            return frame[1:4] == self.address
        command = self.data[0] & _COMMAND
        if command == _SEGMENT:
            return frame[0] & (_COMMAND | _TOGGLE) == self.data[0] & _TOGGLE
        return frame[0] & _COMMAND == _ANSWERS[command] and frame[1:4] == self.address


Transfer = Generator[Request, bytes, bytes]
"""A generator that yields requests, receives their answers, and returns the data read."""


def upload(index: int, sub: int) -> Transfer:
    """Reads an object, expedited or in segments.

    Raises:
        Aborted: the drive refused.
    """
    address = _address(index, sub)
    first = yield from _ask(Request(bytes((_UPLOAD,)) + address + bytes(4), address))
    if first[0] & 2:
        unused = first[0] >> 2 & 3 if first[0] & 1 else 0
        return first[4 : _SIZE - unused]
    data, toggle = b"", 0
    for _ in range(_MOST_SEGMENTS):
        segment = yield from _ask(Request(bytes((_SEGMENT | toggle,)) + bytes(7), address))
        data += segment[1 : _SIZE - (segment[0] >> 1 & 7)]
        if segment[0] & 1:
            break
        toggle ^= _TOGGLE
    return data


def download(index: int, sub: int, data: bytes) -> Transfer:
    """Writes an object of one to four bytes.

    Raises:
        Aborted: the drive refused.
    """
    address = _address(index, sub)
    command = _DOWNLOAD | _EXPEDITED - len(data) << 2 | 3
    yield from _ask(Request(bytes((command,)) + address + data.ljust(_EXPEDITED, b"\0"), address))
    return b""


def abort(request: Request, code: int) -> bytes:
    """Returns the frame that aborts a transfer."""
    return bytes((_ABORT,)) + request.address + struct.pack("<I", code)


def _ask(request: Request) -> Transfer:
    answer = yield request
    if answer[0] == _ABORT:
        raise Aborted(int.from_bytes(answer[4:], "little"))
    return answer


def _address(index: int, sub: int) -> bytes:
    return struct.pack("<HB", index, sub)
