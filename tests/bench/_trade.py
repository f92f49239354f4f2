"""Our own calls: remote ones that are started or waited for, and local ones."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from tests.bench._links import Call, Link, Peer, Pipeline, Threads


class Trade(Peer):
    """A remote call of TRADE: typed, with deadline, identity and checks; of the kind that may move something."""

    name = "TRADE"
    system = "two"

    @contextmanager
    def serve(self) -> Iterator[str]:
        with _container("server", self.system) as container:
            container.register(provider(), "bench")
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
            yield _Shared(container.register(provider(), "bench")[0])


def _container(name: str, system: str):
    from trade import Container, Settings

    return Container(Settings.read(container=name, system=f"bench-{system}"))


def provider() -> object:
    """Something with a service that gives back what it is given."""
    from trade import service

    class Echo:
        @service
        def echo(self, payload: bytes) -> bytes:
            return payload

    return Echo()
