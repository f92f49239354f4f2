"""Modbus RTU as a slave sees it: requests out of a stream of bytes, and the bytes of answers. Pure.

Source: "MODBUS over serial line specification V1.02" and "MODBUS application protocol V1.1b3", functions 03, 04, 06, 16
and 23.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

BROADCAST: Final = 0
MOST_REGISTERS: Final = 125
GAP_S: Final = 0.00175
"""Silence between two requests at more than 19200 baud."""
PATIENCE_S: Final = 0.05
"""A request whose next byte has not come after this long is discarded. Real slaves allow 0.75 ms; a pty adds gaps."""
_HEAD: Final = 2
_CRC: Final = 2


class Function(IntEnum):
    """The functions that a gripper supports."""

    READ = 0x03
    READ_INPUT = 0x04
    WRITE_ONE = 0x06
    WRITE = 0x10
    READ_WRITE = 0x17


class ExceptionCode(IntEnum):
    """Why a request is refused."""

    FUNCTION = 1
    ADDRESS = 2
    VALUE = 3


@dataclass(frozen=True, slots=True)
class Request:
    """One request, parsed as far as its function is known."""

    device_id: int
    function: int
    read_at: int = 0
    read_count: int = 0
    write_at: int = 0
    values: tuple[int, ...] = ()
    whole: bool = True
    """False: its own lengths contradict each other."""

    @property
    def name(self) -> str:
        """Its name in the log and in faults."""
        return Function(self.function).name.lower() if self.function in set(Function) else f"function {self.function}"


def crc16(data: Iterable[int]) -> int:
    """CRC-16 with polynomial 0xA001 (reflected), start 0xFFFF; sent low byte first."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0xA001 if crc & 1 else crc >> 1
    return crc


def frame(body: bytes) -> bytes:
    """The body with its CRC."""
    return body + crc16(body).to_bytes(2, "little")


def read_answer(request: Request, values: Sequence[int]) -> bytes:
    """The answer of functions 03, 04 and 23."""
    data = b"".join(value.to_bytes(2, "big") for value in values)
    return frame(bytes((request.device_id, request.function, len(data))) + data)


def write_answer(request: Request) -> bytes:
    """The answer of functions 06 and 16."""
    tail = request.values[0] if request.function == Function.WRITE_ONE else len(request.values)
    head = bytes((request.device_id, request.function))
    return frame(head + request.write_at.to_bytes(2, "big") + tail.to_bytes(2, "big"))


def exception(request: Request, code: ExceptionCode) -> bytes:
    """The answer to a request that is refused."""
    return frame(bytes((request.device_id, request.function | 0x80, code)))


class RequestReader:
    """Finds requests in the bytes of a client.

    Functions give the lengths of frames, since a pseudo-terminal loses the gaps between them. What
    cannot be a request, or has a wrong CRC, is discarded up to the next silence, like in a slave that measures gaps.
    """

    def __init__(self) -> None:
        self._held = bytearray()
        self._lost = False

    def silence(self, s: float) -> None:
        """Note how long no byte has arrived."""
        if (self._lost and s > GAP_S) or s > PATIENCE_S:
            self._held.clear()
            self._lost = False

    def feed(self, data: bytes) -> Iterator[Request | None]:
        """Every request that these bytes complete; None for a damaged one."""
        if self._lost:
            return
        self._held += data
        while (length := _length(self._held)) is not None:
            known = length > 0
            if known and len(self._held) < length:
                return
            body = bytes(self._held[: length - _CRC]) if known else b""
            if not known or crc16(body) != int.from_bytes(self._held[length - _CRC : length], "little"):
                self._held.clear()
                self._lost = True
                yield None
                return
            del self._held[:length]
            yield _LAYOUTS[body[1]][1](body)


def _length(held: bytearray) -> int | None:
    """Length of the frame that begins here; None while it is unknown, 0 if it is no frame."""
    if len(held) < _HEAD:
        return None
    if held[1] not in _LAYOUTS:
        return 0
    fixed, _ = _LAYOUTS[held[1]]
    if held[1] in {Function.WRITE, Function.READ_WRITE}:
        return fixed + held[fixed - _CRC - 1] if len(held) >= fixed - _CRC else None
    return fixed


def _word(body: bytes, at: int) -> int:
    return int.from_bytes(body[at : at + 2], "big")


def _words(data: bytes) -> tuple[int, ...]:
    return tuple(_word(data, at) for at in range(0, len(data) - 1, 2))


def _reading(body: bytes) -> Request:
    return Request(body[0], body[1], read_at=_word(body, 2), read_count=_word(body, 4))


def _writing_one(body: bytes) -> Request:
    return Request(body[0], body[1], write_at=_word(body, 2), values=(_word(body, 4),))


def _writing(body: bytes) -> Request:
    whole = body[6] == 2 * _word(body, 4)
    return Request(body[0], body[1], write_at=_word(body, 2), values=_words(body[7:]), whole=whole)


def _reading_and_writing(body: bytes) -> Request:
    whole = body[10] == 2 * _word(body, 8)
    values = _words(body[11:])
    return Request(body[0], body[1], _word(body, 2), _word(body, 4), _word(body, 6), values, whole)


_LAYOUTS: Final[dict[int, tuple[int, Callable[[bytes], Request]]]] = {
    Function.READ: (8, _reading),
    Function.READ_INPUT: (8, _reading),
    Function.WRITE_ONE: (8, _writing_one),
    Function.WRITE: (9, _writing),
    Function.READ_WRITE: (13, _reading_and_writing),
}
"""By function: the length of a request without its values, and how to parse its body."""
