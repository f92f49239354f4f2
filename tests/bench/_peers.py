"""What others are measured against: raw TCP, the floor, and a bare zenoh pair, the yardstick."""

import itertools
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from tests.bench._links import Link, Peer, Pipeline

_SIZE_BYTES, _ID_BYTES = 4, 8
_PATIENCE_S = 20.0
_CALLS, _REPLIES = "call/bench", "reply/bench"
_MOST_UNREAD = 256 * 1024
"""Bytes that raw TCP may have under way: with more, both ends could wait to send and neither would read."""


class Tcp(Peer):
    """A blocking socket on each side, a length before each message."""

    name = "raw TCP"

    @contextmanager
    def serve(self) -> Iterator[str]:
        with socket.create_server(("127.0.0.1", 0)) as listener:
            threading.Thread(target=_echo_all, args=(listener,), daemon=True).start()
            yield json.dumps(listener.getsockname())

    @contextmanager
    def connect(self, address: str) -> Iterator[Link]:
        with socket.create_connection(tuple(json.loads(address))) as link:
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            yield TcpLink(link)


class TcpLink(Pipeline):
    """Messages on a socket of any family, a length before each."""

    def __init__(self, link: socket.socket) -> None:
        self._link = link

    def begin(self, payload: bytes) -> None:
        self._link.sendall(len(payload).to_bytes(_SIZE_BYTES, "little") + payload)

    def end(self, begun: None) -> bytes:
        return framed(self._link)[_SIZE_BYTES:]

    def burst(self, payload: bytes, n: int, in_flight: int) -> None:
        super().burst(payload, n, min(in_flight, max(1, _MOST_UNREAD // len(payload))))


def _echo_all(listener: socket.socket) -> None:
    link, _ = listener.accept()
    link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    with link:
        while message := framed(link):
            link.sendall(message)


def framed(link: socket.socket) -> bytes:
    """A message with its length before it; nothing at the end."""
    size = link.recv(_SIZE_BYTES, socket.MSG_WAITALL)
    return size + link.recv(int.from_bytes(size, "little"), socket.MSG_WAITALL) if size else b""


class BarePair(Peer):
    """What our calls are based on, without TRADE around it.

    A channel and a declared publisher on each side, the lease of every TRADE session, an id before the payload.
    """

    name = "bare zenoh pair"

    @contextmanager
    def serve(self) -> Iterator[str]:
        endpoint = _free_endpoint()
        with _bare_session(listen=endpoint) as session:
            serve_bare(session, _CALLS, _REPLIES)
            yield endpoint

    @contextmanager
    def connect(self, address: str) -> Iterator[Link]:
        with _bare_session(connect=address) as session:
            yield bare_link(session, _CALLS, _REPLIES)


class BareLink(Pipeline):
    """Messages with ids before them."""

    def __init__(self, put: Callable[[bytes], Any], receive: Callable[[], Any]) -> None:
        self._put = put
        self._receive = receive
        self._ids = itertools.count(1)

    def begin(self, payload: bytes) -> bytes:
        call_id = next(self._ids).to_bytes(_ID_BYTES, "little")
        self._put(call_id + payload)
        return call_id

    def end(self, begun: bytes) -> bytes:
        while True:
            answer = self._receive().payload.to_bytes()
            if answer[:_ID_BYTES] == begun:
                return answer[_ID_BYTES:]


class BareQuery(BarePair):
    """The other way to call with zenoh alone: a query, and what answers it."""

    name = "bare zenoh query"

    @contextmanager
    def serve(self) -> Iterator[str]:
        endpoint = _free_endpoint()
        with _bare_session(listen=endpoint) as session:
            queryable = session.declare_queryable(_CALLS, _fifo())
            threading.Thread(target=_reply_all, args=(queryable,), daemon=True).start()
            yield endpoint

    @contextmanager
    def connect(self, address: str) -> Iterator[Link]:
        import zenoh

        with _bare_session(connect=address) as session:
            querier = session.declare_querier(_CALLS, target=zenoh.QueryTarget.BEST_MATCHING)
            _wait_until_heard(querier)
            yield _QueryLink(querier)


class _QueryLink(Pipeline):
    def __init__(self, querier) -> None:
        self._querier = querier

    def begin(self, payload: bytes):
        return self._querier.get(payload=payload)

    def end(self, begun) -> bytes:
        return begun.recv().ok.payload.to_bytes()


def _reply_all(queryable) -> None:
    import zenoh

    try:
        while True:
            query = queryable.handler.recv()
            query.reply(_CALLS, query.payload.to_bytes(), express=True)
            query.drop()
    except zenoh.ZError:  # closed
        return


Answer = Callable[[bytes], bytes]


def serve_bare(session, calls: str, replies: str, answer: Answer = bytes) -> None:
    """Answer what comes on one key on another one, until the session closes."""
    heard, answers = session.declare_subscriber(calls, _fifo()), _declare(session, replies)
    threading.Thread(target=_answer_all, args=(heard, answers, answer), daemon=True).start()


def bare_link(session, calls: str, replies: str) -> "BareLink":
    """The caller's end; raises RuntimeError if no server receives its calls."""
    heard, asked = session.declare_subscriber(replies, _fifo()), _declare(session, calls)
    _wait_until_heard(asked)
    return BareLink(asked.put, heard.recv)


def _wait_until_heard(asked) -> None:
    until = time.monotonic() + _PATIENCE_S
    while not asked.matching_status.matching:
        if time.monotonic() > until:
            raise RuntimeError(f"no server receives {asked.key_expr}")
        threading.Event().wait(0.01)


def _answer_all(calls, replies, answer: Answer) -> None:
    import zenoh

    receive, put = calls.handler.recv, replies.put
    try:
        while True:
            message = receive().payload.to_bytes()
            put(message[:_ID_BYTES] + answer(message[_ID_BYTES:]))
    except zenoh.ZError:  # closed
        return


def _bare_session(*, listen: str = "", connect: str = ""):
    import zenoh

    config = zenoh.Config()
    settings = {
        "mode": "peer",
        "listen/endpoints": [listen or _free_endpoint()],
        "connect/endpoints": [connect] if connect else [],
        "scouting/multicast/enabled": False,
        "transport/link/tx/lease": 2000,
        "transport/link/tx/keep_alive": 4,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": 1_000_000,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def _declare(session, key: str):
    import zenoh

    return session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK, express=True)


def _fifo():
    import zenoh

    return zenoh.handlers.FifoChannel(4096)


def _free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"
