"""What a typed call takes at least in Python: its two messages, encoded and decoded at both ends, and nothing else.

For large ones: copies into memory that both ends share, out of it, and into values of Python.
"""

import itertools
import mmap
import os
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

import msgspec
from msgspec import Raw

from tests.bench._links import Call, Link, Peer, Pipeline, Threads
from tests.bench._peers import TcpLink, framed
from trade.protocol.messages import PROTOCOL, LargeBytes, Reply, Status, decode_call, decode_reply
from trade.protocol.messages import Call as CallMessage

_KEY: Final = b"call/bench/bench/server/epoch/bench/Provider-1"
_CALLER: Final = "bench/client/epoch"
_MOST_UNREAD: Final = 128 * 1024
"""Bytes that may be under way: with more, both ends could wait to send and neither would read."""
_SIZE_BYTES: Final = 4
_PLACE_BYTES: Final = 8 << 20
_encode: Final = msgspec.msgpack.Encoder().encode
_decode_arguments: Final = msgspec.msgpack.Decoder(tuple[bytes]).decode
_decode_result: Final = msgspec.msgpack.Decoder(bytes).decode
_NO_BYTES, _NOTHING = Raw(_encode(b"")), _encode(None)


class BareMessages(Peer):
    """No middleware: no deadline is checked, no context made, no right, lock or repetition looked up."""

    name = "bare messages"

    @contextmanager
    def serve(self) -> Iterator[str]:
        with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_UNIX) as listener:
            path = str(Path(folder) / "calls")
            listener.bind(path)
            listener.listen(64)
            threading.Thread(target=self._accept_all, args=(listener,), daemon=True).start()
            yield path

    def _accept_all(self, listener: socket.socket) -> None:
        while True:
            try:
                link, _ = listener.accept()
            except OSError:  # the end
                return
            threading.Thread(target=self.answer_all, args=(link,), daemon=True).start()

    def answer_all(self, link: socket.socket) -> None:
        """Answer the calls on one connection."""
        with link:
            while message := framed(link):
                _send(link, answer(message[_SIZE_BYTES:]))

    @contextmanager
    def connect(self, address: str) -> Iterator[Link]:
        with _connected(address) as link:
            yield TypedMessages(TcpLink(link))


class BareMessagesThreads(BareMessages):
    """The same with callers that wait, each in a thread, with a connection of its own."""

    name = "bare messages, threads"

    @contextmanager
    def connect(self, address: str) -> Iterator[Link]:
        with ExitStack() as stack:
            yield _EachItsOwn(lambda: TypedMessages(TcpLink(stack.enter_context(_connected(address)))))


class BareCopies(BareMessages):
    """Large messages through memory that both ends share: the least that their bytes have to be copied.

    The receiver copies a message out before it reads it, as the sender could still change it, and then into a value.
    """

    name = "bare copies"
    least_bytes = 1 << 20

    def answer_all(self, link: socket.socket) -> None:
        with link, _taken_memory(link) as memory:
            copies = _Copies(link, memory, out=_PLACE_BYTES)
            while message := copies.take():
                call = decode_call(message[len(_KEY) :])
                result = _echo(*_decode_arguments(call.args))
                empty = _encode(Reply(PROTOCOL, call.id, Status.OK, time.monotonic_ns(), _NO_BYTES))
                copies.put(empty[: -len(_NO_BYTES)] + LargeBytes(result).head, result)

    @contextmanager
    def connect(self, address: str) -> Iterator[Link]:
        descriptor = os.memfd_create("bench-copies")
        os.ftruncate(descriptor, 2 * _PLACE_BYTES)
        with _connected(address) as link, mmap.mmap(descriptor, 2 * _PLACE_BYTES) as memory:
            socket.send_fds(link, [b"m"], [descriptor])
            os.close(descriptor)
            yield _CopiedMessages(link, _Copies(link, memory, out=0))


class _Copies:
    """One end of such memory, in which each direction has one place; sizes go over the socket."""

    def __init__(self, link: socket.socket, memory: mmap.mmap, *, out: int) -> None:
        self._link = link
        self._memory = memory
        self._out, self._in = out, _PLACE_BYTES - out
        self._place = memoryview(bytearray(_PLACE_BYTES))

    def put(self, *parts: bytes) -> None:
        at = self._out
        for part in parts:
            self._memory[at : at + len(part)] = part
            at += len(part)
        self._link.sendall((at - self._out).to_bytes(_SIZE_BYTES, "little"))

    def take(self) -> memoryview:
        """The next message; empty at the end."""
        size = int.from_bytes(self._link.recv(_SIZE_BYTES, socket.MSG_WAITALL), "little")
        with memoryview(self._memory) as view:
            self._place[:size] = view[self._in : self._in + size]
        return self._place[:size]


class TypedMessages(Pipeline):
    """The two messages of a call over any link, encoded and decoded at both ends."""

    def __init__(self, link: Pipeline) -> None:
        self._link = link
        self._ids = itertools.count(1)

    def begin(self, payload: bytes) -> Any:
        return self._link.begin(self.message(Raw(_encode((payload,)))))

    def message(self, arguments: Raw) -> bytes:
        expires_ns = time.monotonic_ns() + 10**10
        return _KEY + _encode(
            CallMessage(PROTOCOL, next(self._ids), "echo", "client/1", _CALLER, expires_ns, (), arguments)
        )

    def end(self, begun: Any) -> bytes:
        return _decode_result(decode_reply(self._link.end(begun)).body)

    def burst(self, payload: bytes, n: int, in_flight: int) -> None:
        super().burst(payload, n, min(in_flight, max(1, _MOST_UNREAD // len(payload))))


class _CopiedMessages(TypedMessages):
    def __init__(self, link: socket.socket, copies: _Copies) -> None:
        super().__init__(TcpLink(link))
        self._copies = copies

    def begin(self, payload: bytes) -> None:
        whole = self.message(Raw(_encode((b"",))))  # ends with the empty argument, and with no behalf
        end = len(whole) - len(_NOTHING)
        self._copies.put(whole[: end - len(_NO_BYTES)] + LargeBytes(payload).head, payload, whole[end:])

    def end(self, begun: None) -> bytes:
        return _decode_result(decode_reply(self._copies.take()).body)


class _EachItsOwn(Threads):
    def __init__(self, open_link: Callable[[], Link]) -> None:
        self._open = open_link
        self._links: list[Link] = [open_link()]

    def call(self, payload: bytes) -> bytes:
        return self._links[0].call(payload)

    def several(self, count: int) -> Sequence[Call]:
        self._links += [self._open() for _ in range(count - len(self._links))]
        return [link.call for link in self._links[:count]]


@contextmanager
def _connected(path: str) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX) as link:
        link.connect(path)
        yield link


@contextmanager
def _taken_memory(link: socket.socket) -> Iterator[mmap.mmap]:
    """The memory that the other end made."""
    _, [descriptor], _, _ = socket.recv_fds(link, 1, 1)
    with mmap.mmap(descriptor, 2 * _PLACE_BYTES) as memory:
        os.close(descriptor)
        yield memory


def _send(link: socket.socket, message: bytes) -> None:
    link.sendall(len(message).to_bytes(_SIZE_BYTES, "little") + message)


def answer(message: bytes) -> bytes:
    """The message that answers a message."""
    call = decode_call(message[len(_KEY) :])
    result = Raw(_encode(_echo(*_decode_arguments(call.args))))
    return _encode(Reply(PROTOCOL, call.id, Status.OK, time.monotonic_ns(), result))


def _echo(payload: bytes) -> bytes:
    return payload
