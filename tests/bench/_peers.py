"""What our calls are measured against, and our calls themselves: each echoes 64 bytes between two processes."""

import itertools
import json
import socket
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

PAYLOAD = bytes(range(64))

Call = Callable[[bytes], bytes]


class Peer(ABC):
    """One way to call another process."""

    name: str

    @abstractmethod
    def serve(self) -> AbstractContextManager[str]:
        """Answer calls; gives what ``connect`` needs to find us."""

    @abstractmethod
    def connect(self, address: str) -> AbstractContextManager[Call]:
        """Gives the function that calls."""


class Tcp(Peer):
    """The floor: a blocking socket on each side, messages of fixed length."""

    name = "raw TCP"

    @contextmanager
    def serve(self) -> Iterator[str]:
        with socket.create_server(("127.0.0.1", 0)) as listener:
            threading.Thread(target=_echo_all, args=(listener,), daemon=True).start()
            yield json.dumps(listener.getsockname())

    @contextmanager
    def connect(self, address: str) -> Iterator[Call]:
        with socket.create_connection(tuple(json.loads(address))) as link:
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

            def call(payload: bytes) -> bytes:
                link.sendall(payload)
                return link.recv(len(payload), socket.MSG_WAITALL)

            yield call


def _echo_all(listener: socket.socket) -> None:
    link, _ = listener.accept()
    link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    with link:
        while data := link.recv(len(PAYLOAD), socket.MSG_WAITALL):
            link.sendall(data)


class BarePair(Peer):
    """The yardstick: what our calls stand on, with nothing of ours around it.

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
    def connect(self, address: str) -> Iterator[Call]:
        ids = itertools.count(1)
        with _bare_session(connect=address) as session:
            replies = session.declare_subscriber("reply/bench", _fifo())
            calls = _declare(session, "call/bench")
            while not calls.matching_status.matching:
                threading.Event().wait(0.01)
            receive = replies.handler.recv

            def call(payload: bytes) -> bytes:
                call_id = next(ids).to_bytes(8, "little")
                calls.put(call_id + payload)
                while True:
                    answer = receive().payload.to_bytes()
                    if answer[:8] == call_id:
                        return answer[8:]

            yield call


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


class Rpyc(Peer):
    """The other library of its kind: plain values, no types, no checks."""

    name = "rpyc"

    @contextmanager
    def serve(self) -> Iterator[str]:
        import rpyc
        from rpyc.utils.server import ThreadedServer

        class Echo(rpyc.Service):
            def exposed_echo(self, payload):
                return payload

        server = ThreadedServer(Echo, hostname="127.0.0.1")
        threading.Thread(target=server.start, daemon=True).start()
        try:
            yield str(server.port)
        finally:
            server.close()

    @contextmanager
    def connect(self, address: str) -> Iterator[Call]:
        import rpyc

        with rpyc.connect("127.0.0.1", int(address)) as link:
            yield link.root.echo


class Trade(Peer):
    """A remote call of ours: typed, with deadline, identity and checks; of the kind that may move something."""

    name = "TRADE"

    @contextmanager
    def serve(self) -> Iterator[str]:
        with _container("server", "two") as container:
            container.register(_provider(), "bench")
            yield ""

    @contextmanager
    def connect(self, address: str) -> Iterator[Call]:
        from trade import where

        with _container("client", "two") as container:
            yield container.find(where(name="echo", group="bench"), wait_s=10)


class LocalTrade(Peer):
    """A call of a service in the same container: the same checks and copies, no wire. For information."""

    name = "TRADE, local"

    @contextmanager
    def serve(self) -> Iterator[str]:
        yield ""

    @contextmanager
    def connect(self, address: str) -> Iterator[Call]:
        with _container("alone", "one") as container:
            yield container.register(_provider(), "bench")[0]


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
