"""The server of service data objects: reads and writes of the dictionary, expedited or in segments. Pure."""

from typing import Final, Protocol

from ._store import Abort, AbortCode

EXPEDITED: Final = 4
"""Up to this many bytes fit into the first frame."""
SEGMENT: Final = 7
LONGEST: Final = 1024
"""The greatest length of an object."""
REQUEST: Final = 8


class Dictionary(Protocol):
    """The object dictionary that SDOs read and write; both methods raise `Abort`."""

    def read(self, index: int, sub: int, t: float) -> bytes:
        """The bytes of an object."""
        ...

    def write(self, index: int, sub: int, data: bytes, t: float) -> None:
        """Change an object."""
        ...


class SdoServer:
    """Answers one client's requests of 8 bytes with 8 bytes each (CiA 301, 7.2.4)."""

    def __init__(self, dictionary: Dictionary) -> None:
        self._dictionary = dictionary
        self._address = (0, 0)
        self._unsent: bytes | None = None
        """Bytes still to be uploaded."""
        self._received: bytearray | None = None
        """Bytes downloaded so far."""
        self._size: int | None = None
        self._toggle = 0

    def reset(self) -> None:
        """Discard a transfer that is under way."""
        self._unsent = self._received = None

    def answer(self, request: bytes, t: float) -> bytes | None:
        """The answer to a request, if there is one."""
        if len(request) != REQUEST:
            return None
        try:
            match request[0] >> 5:
                case 1:
                    return self._begin_download(request, t)
                case 0:
                    return self._download_segment(request, t)
                case 2:
                    return self._begin_upload(request, t)
                case 3:
                    return self._upload_segment(request)
                case 4:
                    self.reset()
                    return None
                case _:
                    self._address = _address(request)
                    raise Abort(AbortCode.UNKNOWN_COMMAND)
        except Abort as abort:
            self.reset()
            return self._head(0x80) + int(abort.code).to_bytes(4, "little")

    def _head(self, command: int) -> bytes:
        index, sub = self._address
        return bytes([command]) + index.to_bytes(2, "little") + bytes([sub])

    def _begin_download(self, request: bytes, t: float) -> bytes:
        self.reset()
        self._address, command = _address(request), request[0]
        sized = command & 1
        if command & 2:
            length = EXPEDITED - (command >> 2 & 3) if sized else EXPEDITED
            self._dictionary.write(*self._address, request[4 : 4 + length], t)
        else:
            self._size = int.from_bytes(request[4:], "little") if sized else None
            if self._size is not None and self._size > LONGEST:
                raise Abort(AbortCode.TOO_LONG)
            self._received, self._toggle = bytearray(), 0
        return self._head(0x60) + bytes(4)

    def _download_segment(self, request: bytes, t: float) -> bytes:
        if self._received is None:
            raise Abort(AbortCode.UNKNOWN_COMMAND)
        toggle = self._next_toggle(request)
        self._received += request[1 : 1 + SEGMENT - (request[0] >> 1 & 7)]
        if len(self._received) > LONGEST:
            raise Abort(AbortCode.TOO_LONG)
        if request[0] & 1:
            data, self._received = bytes(self._received), None
            if self._size is not None and len(data) != self._size:
                raise Abort(AbortCode.LENGTH)
            self._dictionary.write(*self._address, data, t)
        return bytes([0x20 | toggle << 4]) + bytes(7)

    def _begin_upload(self, request: bytes, t: float) -> bytes:
        self.reset()
        self._address = _address(request)
        data = self._dictionary.read(*self._address, t)
        if 0 < len(data) <= EXPEDITED:
            return self._head(0x43 | EXPEDITED - len(data) << 2) + data.ljust(EXPEDITED, b"\0")
        self._unsent, self._toggle = data, 0
        return self._head(0x41) + len(data).to_bytes(4, "little")

    def _upload_segment(self, request: bytes) -> bytes:
        if self._unsent is None:
            raise Abort(AbortCode.UNKNOWN_COMMAND)
        toggle = self._next_toggle(request)
        piece, self._unsent = self._unsent[:SEGMENT], self._unsent[SEGMENT:]
        last = not self._unsent
        if last:
            self._unsent = None
        return bytes([toggle << 4 | SEGMENT - len(piece) << 1 | last]) + piece.ljust(SEGMENT, b"\0")

    def _next_toggle(self, request: bytes) -> int:
        toggle = request[0] >> 4 & 1
        if toggle != self._toggle:
            raise Abort(AbortCode.TOGGLE)
        self._toggle = 1 - toggle
        return toggle


def _address(request: bytes) -> tuple[int, int]:
    return int.from_bytes(request[1:3], "little"), request[3]
