"""The transport on zenoh keeps the guarantees of every transport."""

import contextlib
import gc
import secrets
import socket
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from trade.testing import LossConformance, Severable, TransportConformance
from trade.testing._ear import meet
from trade.transport.base import Channel, ChannelClosed, Presence, Questions
from trade.transport.endpoints import free_endpoint
from trade.transport.zenoh import _CHANNEL_CAPACITY, ZenohTransport, configuration


class TestZenoh(TransportConformance):
    @contextlib.contextmanager
    def network(self) -> Iterator[Callable[[], ZenohTransport]]:
        namespace, endpoints = f"test-{secrets.token_hex(4)}", list[str]()
        with contextlib.ExitStack() as stack:
            kept: list[Presence] = []

            def open_transport() -> ZenohTransport:
                endpoint = free_endpoint()
                transport = ZenohTransport(
                    configuration(
                        namespace=namespace, listen=[endpoint], connect=endpoints, credentials=("conformance", "secret")
                    )
                )
                stack.callback(transport.close)
                kept.append(transport.appear(f"linked/{len(endpoints)}"))
                endpoints.append(endpoint)
                _wait_for_links(transport, len(endpoints))
                return transport

            yield open_transport

    def test_unread_samples_block_nothing_if_only_the_newest_is_wanted(self) -> None:
        with self.network() as open_transport:
            here, there = open_transport(), open_transport()
            unread, read = there.subscribe("flood", newest=_CHANNEL_CAPACITY), there.subscribe("call")
            meet(listener=there, speaker=here)
            flood, call = here.publish("flood"), here.publish("call")
            for number in range(2 * _CHANNEL_CAPACITY):
                flood.put(str(number).encode())
            call.put(b"at last")
            assert read.receive().payload == b"at last"
            assert int(unread.receive().payload or b"0") >= _CHANNEL_CAPACITY

    def test_sessions_with_open_publishers_leave_no_files_when_they_are_closed(self) -> None:
        def open_files() -> int:
            gc.collect()
            return sum(1 for _ in Path("/proc/self/fd").iterdir())

        def opened_and_closed() -> None:
            with self.network() as open_transport:
                publisher = open_transport().publish("state")
            with pytest.raises(ChannelClosed):
                publisher.put(b"late")

        opened_and_closed()  # what zenoh opens once for each process
        before = open_files()
        for _ in range(5):
            opened_and_closed()
        assert open_files() <= before + 1  # zenoh closes the memory of one session when the next is opened

    def test_a_wait_for_queries_ends_when_their_queue_is_closed(self) -> None:
        def read(questions: Questions) -> None:
            with contextlib.suppress(ChannelClosed):
                questions.receive()

        with self.network() as open_transport, ThreadPoolExecutor(1, "asked") as other:
            transport = open_transport()
            for _ in range(500):
                questions = transport.questions("anything")
                waiting = other.submit(read, questions)
                questions.close()
                waiting.result(60)

    def test_nothing_is_missed_while_one_settles(self) -> None:
        numbers = range(3000)
        with self.network() as open_transport, ThreadPoolExecutor(1, "putting") as other:
            here, there = open_transport(), open_transport()
            orders, announced = there.subscribe("estop/**"), there.announcements("registry/**")
            meet(listener=there, speaker=here)
            order = here.publish("estop/one")

            def put_all() -> None:
                for number in numbers:
                    order.put(str(number).encode())
                    here.announce(f"registry/{number}", str(number).encode())

            putting = other.submit(put_all)
            begun = [_until(channel, 500) for channel in (orders, announced)]
            there.settle()
            for channel, before in zip((orders, announced), begun, strict=True):
                heard = [before[-1], *_until(channel, numbers[-1])]
                assert sorted(set(heard)) == list(numbers[before[-1] :])
            putting.result(60)

    def test_a_transport_that_settles_can_be_closed(self) -> None:
        def read(channel: Channel) -> None:
            with contextlib.suppress(ChannelClosed):
                while True:
                    channel.receive()

        with self.network() as open_transport, ThreadPoolExecutor(2, "reading") as other:
            transport = open_transport()
            channels = transport.subscribe("estop/**"), transport.announcements("registry/**")
            reading = [other.submit(read, channel) for channel in channels]
            transport.settle()
            transport.settle()  # once more: it has nothing left to do
            for channel in channels:
                channel.close()
            for each in reading:
                each.result(60)
            late = transport.subscribe("estop/**")
            late.close()
            transport.settle()  # a closed subscription receives nothing again
            with pytest.raises(ChannelClosed):
                late.receive()


def _until(channel: Channel, last: int) -> list[int]:
    """The numbers that are heard, up to this one or a later one."""
    heard = list[int]()
    while not heard or heard[-1] < last:
        heard.append(int(channel.receive().payload or b""))
    return heard


@pytest.mark.parametrize(("bridge", "shared"), [([], True), ([["eth0"], ["eth1"]], False)])
def test_a_bridge_shares_no_memory_with_its_neighbours(bridge: list[list[str]], shared: bool) -> None:
    settings = configuration(namespace="lab", listen=["tcp/127.0.0.1:0"], connect=[], bridge=bridge)
    assert settings["transport/shared_memory/enabled"] is shared


def _wait_for_links(transport: ZenohTransport, count: int) -> None:
    signs = transport.presences("linked/*")
    seen: set[str] = set()
    while len(seen) < count:
        seen.add(signs.receive().key)
    signs.close()


class Cable:
    """A TCP relay on loopback that can be pulled out and put back."""

    def __init__(self, endpoint: str) -> None:
        self._far = ("127.0.0.1", int(endpoint.rpartition(":")[2]))
        self._server = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp/127.0.0.1:{self._server.getsockname()[1]}"
        self._lock = threading.Lock()
        self._plugged = True
        self._sockets: list[socket.socket] = []
        self._threads: list[threading.Thread] = []
        self._start(self._accept)

    def _start(self, target: Callable[..., None], *arguments: socket.socket) -> None:
        thread = threading.Thread(target=target, args=arguments, name="cable", daemon=True)
        self._threads.append(thread)
        thread.start()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                near, _ = self._server.accept()
                with self._lock:
                    if not self._plugged:
                        near.close()
                        continue
                    far = socket.create_connection(self._far)
                    self._sockets += [near, far]
                    self._start(self._relay, near, far)
                    self._start(self._relay, far, near)

    def _relay(self, source: socket.socket, target: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                target.sendall(data)
            target.shutdown(socket.SHUT_RDWR)

    def unplug(self) -> None:
        with self._lock:
            self._plugged = False
            for end in self._sockets:
                with contextlib.suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)
                end.close()
            self._sockets.clear()

    def plug(self) -> None:
        self._plugged = True

    def close(self) -> None:
        self.unplug()
        with contextlib.suppress(OSError):
            self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()
        for thread in self._threads:
            thread.join(10)


class TestZenohLosses(LossConformance):
    @contextlib.contextmanager
    def severable(self) -> Iterator[Severable]:
        namespace, endpoint = f"test-{secrets.token_hex(4)}", free_endpoint()
        with contextlib.ExitStack() as stack:
            settings = {"namespace": namespace, "credentials": ("conformance", "secret")}
            one = ZenohTransport(configuration(listen=[endpoint], connect=[], **settings))
            stack.callback(one.close)
            cable = Cable(endpoint)
            stack.callback(cable.close)
            other = ZenohTransport(configuration(listen=[free_endpoint()], connect=[cable.endpoint], **settings))
            stack.callback(other.close)
            signs = one.appear("linked/0"), other.appear("linked/1")
            _wait_for_links(other, len(signs))
            yield Severable(one, other, cable.unplug, cable.plug)


def test_of_two_sessions_of_a_host_the_one_that_began_later_has_the_greater_id() -> None:
    """zenoh compares the last byte first; the greater one dials."""
    ids = [configuration(namespace="lab", listen=[], connect=[])["id"] for _ in range(3)]
    ids += [
        configuration(namespace="lab", listen=listen, connect=[], began_ns=began_ns)["id"]
        for listen in (["tcp/127.0.0.1:1"], ["tcp/0.0.0.0:1"])
        for began_ns in (0, 70_000, 1_000_000_000, 10**17)
    ]
    here_only, anywhere = ids[3:7], ids[7:]
    order = [*anywhere[:3], *here_only[:3]]
    assert sorted(order, key=lambda one: bytes.fromhex(one)[::-1]) == order
    assert [int(one[-2:], 16) < 0x80 for one in ids] == [False] * 7 + [True] * 4
    assert len({one[:20] for one in ids}) == len(ids)


def test_a_session_keeps_the_id_of_its_settings() -> None:
    settings = configuration(namespace="lab", listen=[free_endpoint()], connect=[], credentials=("a", "b"), began_ns=0)
    transport = ZenohTransport(settings)
    try:
        assert str(transport._session.zid()) == settings["id"]
    finally:
        transport.close()
