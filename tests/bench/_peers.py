"""Ways to call another process, each echoing bytes: the floor, the yardstick, and our own calls."""

import itertools
import json
import socket
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from importlib.util import find_spec
from typing import Any

Call = Callable[[bytes], bytes]

_SIZE_BYTES = 4
_MOST_UNREAD = 256 * 1024
"""Bytes that raw TCP may have under way: with more, both ends could wait to send and nobody would read."""


class Link(ABC):
    """A connection of a caller."""

    @abstractmethod
    def call(self, payload: bytes) -> bytes:
        """Send, and wait for the echo."""

    @abstractmethod
    def burst(self, payload: bytes, n: int, in_flight: int) -> None:
        """n calls, so many of them under way at a time, in the way that fits the peer best."""


class Peer(ABC):
    """One way to call another process."""

    name: str
    needs = ""
    """The module without which it cannot run."""

    @property
    def missing(self) -> bool:
        return bool(self.needs) and find_spec(self.needs) is None

    @abstractmethod
    def serve(self) -> AbstractContextManager[str]:
        """Answer calls; gives what ``connect`` needs to find us."""

    @abstractmethod
    def connect(self, address: str) -> AbstractContextManager[Link]:
        """Be ready to call."""


class Pipeline(Link):
    """A link whose calls can begin before others have ended."""

    def burst(self, payload: bytes, n: int, in_flight: int) -> None:
        waiting: deque[Any] = deque()
        for _ in range(n):
            if len(waiting) == in_flight:
                check(payload, self.end(waiting.popleft()))
            waiting.append(self.begin(payload))
        while waiting:
            check(payload, self.end(waiting.popleft()))

    def call(self, payload: bytes) -> bytes:
        return self.end(self.begin(payload))

    @abstractmethod
    def begin(self, payload: bytes) -> Any: ...
    @abstractmethod
    def end(self, begun: Any) -> bytes: ...


class Threads(Link):
    """A link whose callers wait, each in a thread of its own."""

    def burst(self, payload: bytes, n: int, in_flight: int) -> None:
        left = itertools.count(1).__next__
        wrong: list[BaseException] = []

        def work(call: Call) -> None:
            try:
                while left() <= n:
                    check(payload, call(payload))
            except Exception as bad:  # noqa: BLE001 - told by the thread that waits for all
                wrong.append(bad)

        threads = [threading.Thread(target=work, args=(call,)) for call in self.several(in_flight)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        if wrong:
            raise wrong[0]

    @abstractmethod
    def several(self, count: int) -> Sequence[Call]:
        """Calls of which each may be made by another thread."""


def check(payload: bytes, answer: bytes) -> None:
    if answer != payload:
        raise RuntimeError(f"a wrong answer of {len(answer)} bytes: {answer[:80]!r}")


# --- the floor


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
            yield _TcpLink(link)


class _TcpLink(Pipeline):
    def __init__(self, link: socket.socket) -> None:
        self._link = link

    def begin(self, payload: bytes) -> None:
        self._link.sendall(len(payload).to_bytes(_SIZE_BYTES, "little") + payload)

    def end(self, begun: None) -> bytes:
        return _framed(self._link)[_SIZE_BYTES:]

    def burst(self, payload: bytes, n: int, in_flight: int) -> None:
        super().burst(payload, n, min(in_flight, max(1, _MOST_UNREAD // len(payload))))


def _echo_all(listener: socket.socket) -> None:
    link, _ = listener.accept()
    link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    with link:
        while message := _framed(link):
            link.sendall(message)


def _framed(link: socket.socket) -> bytes:
    """A message with its length before it; nothing at the end."""
    size = link.recv(_SIZE_BYTES, socket.MSG_WAITALL)
    return size + link.recv(int.from_bytes(size, "little"), socket.MSG_WAITALL) if size else b""


# --- the yardstick


class BarePair(Peer):
    """What our calls stand on, with nothing of ours around it.

    A channel and a declared publisher on each side, the lease every session of ours has, an id before the payload.
    """

    name = "bare zenoh pair"

    @contextmanager
    def serve(self) -> Iterator[str]:
        endpoint = _free_endpoint()
        with _bare_session(listen=endpoint) as session:
            calls = session.declare_subscriber("call/bench", _fifo())
            replies = _declare(session, "reply/bench")
            threading.Thread(target=_answer_all, args=(calls, replies), daemon=True).start()
            yield endpoint

    @contextmanager
    def connect(self, address: str) -> Iterator[Link]:
        with _bare_session(connect=address) as session:
            replies = session.declare_subscriber("reply/bench", _fifo())
            calls = _declare(session, "call/bench")
            while not calls.matching_status.matching:
                threading.Event().wait(0.01)
            yield _BareLink(calls.put, replies.handler.recv)


class _BareLink(Pipeline):
    def __init__(self, put: Callable[[bytes], Any], receive: Callable[[], Any]) -> None:
        self._put = put
        self._receive = receive
        self._ids = itertools.count(1)

    def begin(self, payload: bytes) -> bytes:
        call_id = next(self._ids).to_bytes(8, "little")
        self._put(call_id + payload)
        return call_id

    def end(self, begun: bytes) -> bytes:
        while True:
            answer = self._receive().payload.to_bytes()
            if answer[:8] == begun:
                return answer[8:]


def _answer_all(calls, replies) -> None:
    import zenoh

    receive, put = calls.handler.recv, replies.put
    try:
        while True:
            put(receive().payload.to_bytes())
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


# --- ours


class Trade(Peer):
    """A remote call of ours: typed, with deadline, identity and checks; of the kind that may move something."""

    name = "TRADE"
    system = "two"

    @contextmanager
    def serve(self) -> Iterator[str]:
        with _container("server", self.system) as container:
            container.register(_provider(), "bench")
            yield ""

    @contextmanager
    def connect(self, address: str) -> Iterator[Link]:
        from trade import where

        with _container("client", self.system) as container:
            yield self.link(container.find(where(name="echo", group="bench"), wait_s=10))

    def link(self, handle) -> Link:
        return _Started(handle)


class _Started(Pipeline):
    def __init__(self, handle) -> None:
        self._handle = handle

    def call(self, payload: bytes) -> bytes:
        return self._handle(payload)

    def begin(self, payload: bytes) -> Any:
        return self._handle.start(payload)

    def end(self, begun) -> bytes:
        return begun.result()


class TradeThreads(Trade):
    """The same with callers that wait, each in a thread."""

    name = "TRADE, threads"
    system = "threads"

    def link(self, handle) -> Link:
        return _Shared(handle)


class _Shared(Threads):
    """One handle, called by every thread."""

    def __init__(self, handle) -> None:
        self._handle = handle

    def call(self, payload: bytes) -> bytes:
        return self._handle(payload)

    def several(self, count: int) -> Sequence[Call]:
        return [self._handle] * count


class LocalTrade(Peer):
    """A call of a service in the same container: the same checks and copies, no wire. For information."""

    name = "TRADE, local"

    @contextmanager
    def serve(self) -> Iterator[str]:
        yield ""

    @contextmanager
    def connect(self, address: str) -> Iterator[Link]:
        with _container("alone", "one") as container:
            yield _Shared(container.register(_provider(), "bench")[0])


def _container(name: str, system: str):
    from trade import Container, Settings

    return Container(Settings.read(container=name, system=f"bench-{system}"))


def _provider() -> object:
    from trade import service

    class Echo:
        @service
        def echo(self, payload: bytes) -> bytes:
            return payload

    return Echo()
