"""Requests to the nodes of one CAN bus that do not block: SDO transfers (CiA 301, 7.2.4) and network management."""

import struct
import time
from collections import deque
from collections.abc import Callable, Generator
from typing import Final, NamedTuple, TypeVar

from canopen.emcy import EmcyError
from canopen.sdo.exceptions import SdoAbortedError

from trade_drivers.bus.can import Listeners
from trade_drivers.joints import Gate
from trade_drivers.vendors.cia402 import _table as table
from trade_drivers.vendors.cia402._table import DictionaryEntry

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
_ATTEMPTS: Final = 3
_ANSWER_S: Final = 0.25
"""Timeout of one answer: drives take milliseconds, a busy host takes longer, and nothing is blocked meanwhile."""
_KEPT: Final = 8
"""Frames of a server that are kept; at most one of them is the answer."""

_T = TypeVar("_T")
Answer = Generator[None, None, _T]
"""Yields until the answer has arrived, and returns its value."""


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
    first = yield from _answer_to(Request(bytes((_UPLOAD,)) + address + bytes(4), address))
    if first[0] & 2:
        unused = first[0] >> 2 & 3 if first[0] & 1 else 0
        return first[4 : _SIZE - unused]
    data, toggle = b"", 0
    for _ in range(_MOST_SEGMENTS):
        segment = yield from _answer_to(Request(bytes((_SEGMENT | toggle,)) + bytes(7), address))
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
    yield from _answer_to(Request(bytes((command,)) + address + data.ljust(_EXPEDITED, b"\0"), address))
    return b""


def abort(request: Request, code: int) -> bytes:
    """Returns the frame that aborts a transfer."""
    return bytes((_ABORT,)) + request.address + struct.pack("<I", code)


def _answer_to(request: Request) -> Transfer:
    answer = yield request
    if answer[0] == _ABORT:
        raise Aborted(int.from_bytes(answer[4:], "little"))
    return answer


def _address(index: int, sub: int) -> bytes:
    return struct.pack("<HB", index, sub)


class NoAnswer(Exception):
    """A drive did not answer this request in time."""


class DriveRefused(Exception):
    """A drive refused a request."""

    def __init__(self, entry: object, code: int, text: str) -> None:
        super().__init__(f"{entry}: {text}")
        self.code = code


def emergency_text(code: int) -> str:
    """Returns a short text for a drive's error code."""
    known = _CODES.get(code) or EmcyError(code, 0, b"", 0.0).get_desc()
    return f"error {code:04X}h" + (f", {known.lower()}" if known else "")


_CODES: Final = {
    0x2310: "continuous over-current",
    0x3210: "over-voltage",
    0x3220: "under-voltage",
    0x4210: "over-temperature of the device",
    0x4310: "over-temperature of the drive",
    0x7305: "encoder",
    0x8120: "its CAN controller is error passive",
    0x8130: "it has not heard this driver for too long",
    0x8140: "it has come back from bus-off",
    0x8210: "a PDO was too short",
    0x8611: "following error",
}


class Net:
    """The nodes of one CAN bus."""

    def __init__(self, listeners: Listeners) -> None:
        self._listeners = listeners
        self._port = listeners.port
        self._answers: dict[int, deque[bytes]] = {}
        """The received frames of each node's SDO server."""

    def command(self, node: int, word: int) -> None:
        """Sends a network management command, such as start; it has no confirmation."""
        self._port.send(table.NMT, bytes((word, node)))

    def read(self, node: int, entry: DictionaryEntry) -> Answer[int]:
        """Reads a number from a drive's dictionary.

        Raises:
            NoAnswer, Refused: the request failed.
        """
        data = yield from self._ask(node, entry, lambda: upload(entry.index, entry.sub))
        if len(data) < entry.size:
            raise DriveRefused(entry, 0, f"it came with {len(data)} bytes, not {entry.size}")
        return entry.decode(data)

    def read_text(self, node: int, index: int) -> Answer[str]:
        """Reads a text from a drive's dictionary."""
        data = yield from self._ask(node, f"{index:04X}h", lambda: upload(index, 0))
        return data.rstrip(b"\0 ").decode("ascii", "replace")

    def write(self, node: int, entry: DictionaryEntry, value: int, gate: Gate = lambda: None) -> Answer[None]:
        """Writes a number to a drive's dictionary, with retries; the gate is called before each attempt."""

        def gated_download() -> Transfer:
            gate()
            return download(entry.index, entry.sub, entry.encode(value))

        yield from self._ask(node, entry, gated_download)

    def _ask(self, node: int, entry: object, begin: Callable[[], Transfer]) -> Answer[bytes]:
        for _ in range(_ATTEMPTS):
            try:
                data = yield from self._transfer(node, begin())
            except Aborted as refused:
                raise DriveRefused(entry, refused.code, str(SdoAbortedError(refused.code))) from None
            if data is not None:
                return data
        raise NoAnswer(f"{entry}: no answer within {_ATTEMPTS * _ANSWER_S * 1e3:.0f} ms")

    def _transfer(self, node: int, transfer: Transfer) -> Answer[bytes | None]:
        """Returns the outcome; None if an answer is missing."""
        answers = self._answers_of(node)
        request = next(transfer)
        while True:
            answers.clear()
            self._port.send(table.SDO_REQUEST + node, request.data)
            give_up_at = time.monotonic() + _ANSWER_S
            while (answer := next(filter(request.is_answered_by, answers), None)) is None:
                if self._listeners.heard_until(give_up_at):
                    self._port.send(table.SDO_REQUEST + node, abort(request, TIMED_OUT))
                    return None
                yield
            try:
                request = transfer.send(answer)
            except StopIteration as done:
                return done.value

    def _answers_of(self, node: int) -> deque[bytes]:
        if node not in self._answers:
            self._answers[node] = deque(maxlen=_KEPT)
            self._listeners.hear(table.SDO_ANSWER + node, self._answers[node].append)
        return self._answers[node]
