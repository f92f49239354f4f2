"""A connection between two containers of one host, which carries whole messages."""

import contextlib
import select
import socket
import struct
import threading
from collections import deque
from collections.abc import Iterable
from typing import Final, cast

from msgspec import Raw

from trade.protocol.messages import LARGE, MOST_BYTES, Malformed
from trade.transport.host_socket import process_of
from trade.transport.shared_segment import SharedSegment

_HEADER: Final = struct.Struct("<IH")
"""The bytes of the payload, and those of the key before it, with the marks of a shared segment."""
_SHARED: Final = 0x8000
"""Mark: the payload is not on the socket but in the segment."""
_COPIED: Final = 0x4000
"""Mark: the sender has copied the last payload out of the segment, or has just taken the segment."""
_MOST_BYTES: Final = MOST_BYTES + (1 << 20)
_MOST_KEY_BYTES: Final = 1024
_ROOM: Final = 128 << 10
_BUFFER: Final = 1 << 20
"""What the system may keep of what one end has sent; it may allow less."""
_JOINED: Final = 8 << 10
"""The largest payload that is copied behind its key, which takes less time than giving both to the system."""
_ENDED_THERE: Final = getattr(select, "POLLRDHUP", 0) | getattr(select, "POLLHUP", 0)
"""The first one exists on Linux only."""
_MOST_KEPT: Final = 4 << 20
"""The largest memory that is kept for a later payload."""
_kept: Final[deque[bytearray]] = deque(maxlen=4)
"""Memory of large payloads, in use or free: to use it again takes less time than to get more."""


class ConnectionEnded(Exception):
    """The other end is gone, or one end has broken the connection off."""


class LocalConnection:
    """Sends and receives messages on a connected, blocking stream socket; one thread receives."""

    def __init__(self, sock: socket.socket, received: bytes = b"") -> None:
        """``received`` was read before."""
        self._sock = sock
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
        self._room = bytearray(_ROOM)
        self._view = memoryview(self._room)
        self._view[: len(received)] = received
        self._begin = 0
        self._end = len(received)
        self._segment: SharedSegment | None = None
        self._marks = 0
        """The marks of the next message."""
        self.large = False
        """Whether a large payload passed without a segment."""
        self._open = threading.Lock()
        """Held to shut the socket down or to close it: after that, its number may be another file's."""
        self._closed = False

    def send(self, *parts: bytes | Raw, key: bytes = b"") -> None:
        """Sends one message, and waits while the other end does not read. Raises ConnectionEnded.

        Args:
            parts: the parts of the payload.
            key: its key.
        """
        size, key_size, segment = sum(map(len, parts)), len(key), self._segment
        if self._marks:
            key_size |= self._marks
            self._marks = 0
        if size >= LARGE:
            if segment is None:
                self.large = True
            elif segment.free and size <= segment.most_bytes:
                segment.put(parts)
                key_size |= _SHARED
                parts = ()
        head = _HEADER.pack(size, key_size) + key
        try:
            if size <= _JOINED or not parts:
                self._sock.sendall(b"".join((head, *parts)))
            else:
                self._send_large((head, *parts))
        except OSError:
            raise ConnectionEnded from None

    def _send_large(self, parts: Iterable[bytes | Raw]) -> None:
        sent = self._sock.sendmsg(parts)
        for part in parts:
            if sent < len(part):
                self._sock.sendall(memoryview(part)[sent:])
            sent = max(0, sent - len(part))

    def offer(self, greeting: bytes, segment: SharedSegment, descriptor: int) -> None:
        """Sends the first message, and a segment with its descriptor. Raises ConnectionEnded."""
        self._segment = segment
        with contextlib.suppress(OSError):
            socket.send_fds(self._sock, [_HEADER.pack(len(greeting), 0) + greeting], [descriptor])
            return
        self.send(greeting)  # without it: there are too many descriptors on the way

    def take(self, segment: SharedSegment) -> None:
        """Uses a segment that the other end offered, and confirms that with the next message."""
        self._segment = segment
        self._marks = _COPIED

    def receive(self, most_bytes: int = _MOST_BYTES) -> tuple[bytes, bytes]:
        """Waits for the next message, with a limit for its payload; returns its key and its payload.

        Raises:
            ConnectionEnded: there are no more.
            Malformed: what arrived is not one.
        """
        while self._end - self._begin < _HEADER.size:
            self._read()
        size, key_size = _HEADER.unpack_from(self._room, self._begin)
        shared, segment = False, self._segment
        if key_size > _MOST_KEY_BYTES and segment is not None:
            shared, key_size = self._marked(key_size, size, segment)
        if size > most_bytes or key_size > _MOST_KEY_BYTES:
            raise Malformed(f"a message of {size} bytes with a key of {key_size} bytes")
        if size >= LARGE and segment is None:
            self.large = True
        head = _HEADER.size + key_size
        while self._end - self._begin < (head if shared else min(head + size, _ROOM)):
            self._read()
        middle = self._begin + head
        key = bytes(self._view[self._begin + _HEADER.size : middle])
        if shared and segment is not None:
            self._begin, place = middle, _place_for(size)
            segment.copy_to(place)
            self._marks = _COPIED
            return key, cast("bytes", place)
        if head + size > _ROOM:
            return key, self._receive_large(middle, size)
        payload = bytes(self._view[middle : middle + size])
        self._begin = middle + size
        return key, payload

    def _marked(self, key_size: int, size: int, segment: SharedSegment) -> tuple[bool, int]:
        """Whether the payload is in the segment, and the size of the key without marks."""
        if key_size & _COPIED:
            segment.free = True
        shared = bool(key_size & _SHARED)
        if shared and not LARGE <= size <= segment.most_bytes:
            raise Malformed(f"a payload of {size} bytes in shared memory")
        return shared, key_size & ~(_COPIED | _SHARED)

    def _read(self) -> None:
        begin, end = self._begin, self._end
        if begin == end:
            self._begin = self._end = end = 0
        elif end == _ROOM:
            self._room[: end - begin] = self._room[begin:end]
            self._begin, self._end = 0, end - begin
            end -= begin
        self._end += self._receive_into(self._view[end:])

    def _receive_into(self, place: memoryview) -> int:
        while True:
            try:
                got = self._sock.recv_into(place)
            except BlockingIOError:  # a look for an interrupt
                continue
            except OSError:
                raise ConnectionEnded from None
            if not got:
                raise ConnectionEnded
            return got

    def _receive_large(self, begin: int, size: int) -> bytes:
        """A payload that the room is too small for: all that the room still has, and then what follows.

        It is received into its place, and stays there: a memoryview, which readers use like bytes.
        """
        payload = _place_for(size)
        got = self._end - begin
        payload[:got] = self._view[begin : self._end]
        self._begin = self._end = 0
        while got < size:
            got += self._receive_into(payload[got:])
        return cast("bytes", payload)

    @property
    def process(self) -> int:
        """The process at the other end; 0 if it is unknown."""
        return process_of(self._sock)

    @property
    def ended_there(self) -> bool:
        """Whether the other end has broken it off, though messages may still be read. For the thread that receives."""
        ends = select.poll()
        ends.register(self._sock, _ENDED_THERE)
        return any(events & _ENDED_THERE for _, events in ends.poll(0))

    def hang_up(self) -> None:
        """Receives no more: the receiving thread ends when it is done with what it has. From any thread."""
        self._shut(socket.SHUT_RD)

    def break_off(self) -> None:
        """Ends the connection for both ends; wakes the thread that receives. From any thread."""
        self._shut(socket.SHUT_RDWR)

    def _shut(self, how: int) -> None:
        with self._open, contextlib.suppress(OSError):
            if not self._closed:
                self._sock.shutdown(how)

    def abandon(self) -> None:
        """Lets go of it in a forked child, without a lock; it continues in the parent."""
        self._sock.close()
        if self._segment is not None:
            self._segment.close()

    def close(self) -> None:
        """Ends the connection. No other thread may send or receive then: its socket's number is used again."""
        with self._open:
            self._closed = True
            self._sock.close()
            if self._segment is not None:
                self._segment.close()


def _place_for(size: int) -> memoryview:
    """Memory for a large payload: kept one if no view of it exists any more."""
    for _ in range(len(_kept)):
        try:
            place = _kept.popleft()  # from here on no other thread has it
        except IndexError:
            break
        with contextlib.suppress(BufferError):  # refused while a view of it exists
            place.append(place.pop())
            if len(place) >= size:
                view = memoryview(place)[:size]
                _kept.append(place)
                return view
        _kept.append(place)
    made = bytearray(size)
    view = memoryview(made)
    if size <= _MOST_KEPT:
        _kept.append(made)
    return view
