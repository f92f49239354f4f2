"""Viam's own SDK: a component of its Python server, called by its client over gRPC, as its users call one.

Its server for whole machines is a program in no package registry; this one is what its modules are run with.
"""

import asyncio
import base64
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.bench._links import Link, Peer, check

_ROOT = Path(__file__).parents[2]
_PYTHON = _ROOT / "build" / "viam" / "bin" / "python"
"""An environment of its own, as it wants another protobuf than the gateway's libraries do."""
_NAME = "echo"
_PATIENCE_S = 20.0


class Viam(Peer):
    """A generic component's ``do_command``: bytes travel as base64, because its values are those of JSON."""

    name = "Viam SDK"
    python = str(_PYTHON)
    most_bytes = 1 << 20  # 2 MiB take 0.1 to 0.2 s

    @property
    def missing(self) -> str:
        return "" if _PYTHON.exists() else f"its environment is not there: make {_PYTHON.relative_to(_ROOT)}"

    @contextmanager
    def serve(self) -> Iterator[str]:
        loop = asyncio.new_event_loop()
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        threading.Thread(target=loop.run_forever, daemon=True).start()
        server = asyncio.run_coroutine_threadsafe(_begin(port), loop).result(_PATIENCE_S)
        yield f"127.0.0.1:{port}"
        loop.call_soon_threadsafe(server._server.close)

    @contextmanager
    def connect(self, address: str) -> Iterator[Link]:
        from viam.components.generic import GenericClient
        from viam.rpc.dial import DialOptions, dial_direct

        loop = asyncio.new_event_loop()
        channel = loop.run_until_complete(dial_direct(address, DialOptions(insecure=True, disable_webrtc=True)))
        try:
            yield _Client(loop, GenericClient(_NAME, channel))
        finally:
            channel.close()
            loop.close()


class _Client(Link):
    """Calls of one loop, awaited one by one or several at a time."""

    def __init__(self, loop: asyncio.AbstractEventLoop, client) -> None:
        self._loop = loop
        self._client = client

    def call(self, payload: bytes) -> bytes:
        return self._loop.run_until_complete(self._echo(payload))

    def burst(self, payload: bytes, n: int, in_flight: int) -> None:
        self._loop.run_until_complete(self._all(payload, n, in_flight))

    async def _all(self, payload: bytes, n: int, in_flight: int) -> None:
        left = iter(range(n))

        async def work() -> None:
            for _ in left:
                check(payload, await self._echo(payload))

        await asyncio.gather(*(work() for _ in range(in_flight)))

    async def _echo(self, payload: bytes) -> bytes:
        answer = await self._client.do_command({"payload": base64.b64encode(payload).decode()})
        return base64.b64decode(answer["payload"])


async def _begin(port: int):
    from viam.components.generic import Generic
    from viam.rpc.server import Server

    class Echo(Generic):
        async def do_command(self, command, *, timeout=None, **_):
            return command

        async def get_geometries(self, *, extra=None, timeout=None, **_):
            return []

    server = Server([Echo(_NAME)])
    await server._server.start("127.0.0.1", port)  # its own ``serve`` is for the main thread: it handles signals
    return server
