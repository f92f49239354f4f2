"""Other libraries that call other processes. Each is imported by its own processes only, and skipped where missing."""

import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, contextmanager

from tests.bench._links import Call, Link, Peer, Pipeline, Threads

_WORKERS = 32


class _OwnConnections(Threads):
    """A connection for each thread: what these libraries ask their users for."""

    def __init__(self, connect: Callable[[], AbstractContextManager[Call]], stack: ExitStack) -> None:
        self._connect = connect
        self._stack = stack
        self._calls: list[Call] = []

    def call(self, payload: bytes) -> bytes:
        return self.several(1)[0](payload)

    def several(self, count: int) -> Sequence[Call]:
        while len(self._calls) < count:
            self._calls.append(self._stack.enter_context(self._connect()))
        return self._calls[:count]


class Rpyc(Peer):
    """The other library of its kind: plain values, no types, no checks.

    What is beyond 3000 bytes it would compress, which on one host takes twenty times as long as the rest.
    """

    name = needs = "rpyc"

    @contextmanager
    def serve(self) -> Iterator[str]:
        import rpyc
        from rpyc.utils.server import ThreadedServer

        class Echo(rpyc.Service):
            def on_connect(self, conn):
                _at_its_best(conn)

            def exposed_echo(self, payload):
                return payload

        server = ThreadedServer(Echo, hostname="127.0.0.1")
        threading.Thread(target=server.start, daemon=True).start()
        try:
            yield str(server.port)
        finally:
            server.close()

    @contextmanager
    def connect(self, address: str) -> Iterator[Link]:
        import rpyc

        @contextmanager
        def one() -> Iterator[Call]:
            with rpyc.connect("127.0.0.1", int(address)) as link:
                _at_its_best(link)
                yield link.root.echo

        with ExitStack() as stack:
            yield _OwnConnections(one, stack)


def _at_its_best(connection) -> None:
    """With delays, messages beyond 64 000 bytes take 40 ms each way, and the table would say nothing else."""
    connection._channel.compress = False
    connection._channel.stream.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


class Pyro5(Peer):
    """Remote objects, with the fastest of its serialisers that needs nothing else."""

    name = needs = "Pyro5"

    @contextmanager
    def serve(self) -> Iterator[str]:
        from Pyro5.api import Daemon, behavior, config, expose

        config.SERIALIZER = "marshal"

        @expose
        @behavior(instance_mode="single")
        class Echo:
            def echo(self, payload):
                return payload

        daemon = Daemon(host="127.0.0.1")
        uri = daemon.register(Echo)
        threading.Thread(target=daemon.requestLoop, daemon=True).start()
        try:
            yield str(uri)
        finally:
            daemon.shutdown()

    @contextmanager
    def connect(self, address: str) -> Iterator[Link]:
        from Pyro5.api import Proxy, config

        config.SERIALIZER = "marshal"

        @contextmanager
        def one() -> Iterator[Call]:
            proxy = Proxy(address)
            yield lambda payload: _owned(proxy).echo(payload)
            _owned(proxy)._pyroRelease()

        with ExitStack() as stack:
            yield _OwnConnections(one, stack)


def _owned(proxy):
    """A proxy belongs to the thread that made it until another one claims it, which costs next to nothing."""
    proxy._pyroClaimOwnership()
    return proxy


class Grpc(Peer):
    """HTTP/2 with pure byte handlers: nothing is parsed on either side."""

    name = "gRPC"
    needs = "grpc"

    @contextmanager
    def serve(self) -> Iterator[str]:
        import grpc

        echo = grpc.unary_unary_rpc_method_handler(lambda payload, _: payload)
        server = grpc.server(ThreadPoolExecutor(_WORKERS))
        server.add_generic_rpc_handlers([grpc.method_handlers_generic_handler("bench", {"echo": echo})])
        port = server.add_insecure_port("127.0.0.1:0")
        server.start()
        try:
            yield f"127.0.0.1:{port}"
        finally:
            server.stop(None).wait()

    @contextmanager
    def connect(self, address: str) -> Iterator[Link]:
        import grpc

        with grpc.insecure_channel(address) as channel:
            yield _Future(channel.unary_unary("/bench/echo"))


class _Future(Pipeline):
    def __init__(self, echo) -> None:
        self._echo = echo

    def call(self, payload: bytes) -> bytes:
        return self._echo(payload)

    def begin(self, payload: bytes):
        return self._echo.future(payload)

    def end(self, begun) -> bytes:
        return begun.result()
