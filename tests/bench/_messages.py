"""What a typed call takes at least in Python: its two messages, encoded and decoded at both ends, and nothing else."""

import itertools
import socket
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import msgspec
from msgspec import Raw

from tests.bench._links import Link, Peer, Pipeline
from tests.bench._peers import framed
from trade.protocol.messages import PROTOCOL, Call, Reply, Status, decode_call, decode_reply

_KEY: Final = b"call/bench/bench/server/epoch/bench/Provider-1"
_CALLER: Final = "bench/client/epoch"
_MOST_UNREAD: Final = 128 * 1024
"""Bytes that may be under way: with more, both ends could wait to send and neither would read."""
_encode: Final = msgspec.msgpack.Encoder().encode
_decode_arguments: Final = msgspec.msgpack.Decoder(tuple[bytes]).decode
_decode_result: Final = msgspec.msgpack.Decoder(bytes).decode


class BareMessages(Peer):
    """No middleware: no deadline is checked, no context made, no right, lock or repetition looked up."""

    name = "bare messages"

    @contextmanager
    def serve(self) -> Iterator[str]:
        with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_UNIX) as listener:
            path = str(Path(folder) / "calls")
            listener.bind(path)
            listener.listen()
            threading.Thread(target=_answer_all, args=(listener,), daemon=True).start()
            yield path

    @contextmanager
    def connect(self, address: str) -> Iterator[Link]:
        with socket.socket(socket.AF_UNIX) as link:
            link.connect(address)
            yield _Messages(link)


class _Messages(Pipeline):
    def __init__(self, link: socket.socket) -> None:
        self._link = link
        self._ids = itertools.count(1)

    def begin(self, payload: bytes) -> None:
        arguments, expires_ns = Raw(_encode((payload,))), time.monotonic_ns() + 10**10
        call = Call(PROTOCOL, next(self._ids), "echo", "client/1", _CALLER, expires_ns, (), arguments)
        _send(self._link, _KEY + _encode(call))

    def end(self, begun: None) -> bytes:
        return _decode_result(decode_reply(framed(self._link)[4:]).body)

    def burst(self, payload: bytes, n: int, in_flight: int) -> None:
        super().burst(payload, n, min(in_flight, max(1, _MOST_UNREAD // len(payload))))


def _send(link: socket.socket, message: bytes) -> None:
    link.sendall(len(message).to_bytes(4, "little") + message)


def _answer_all(listener: socket.socket) -> None:
    link, _ = listener.accept()
    with link:
        while message := framed(link):
            call = decode_call(message[4 + len(_KEY) :])
            result = Raw(_encode(_echo(*_decode_arguments(call.args))))
            _send(link, _encode(Reply(PROTOCOL, call.id, Status.OK, time.monotonic_ns(), result)))


def _echo(payload: bytes) -> bytes:
    return payload
