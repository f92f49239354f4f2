"""Large values on the local path pass through shared memory, and through the socket wherever that is not possible."""

import errno
import fcntl
import os
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from tests.support.certificates import Papers
from tests.support.waiting import wait_until
from tests.unit.trade.test_local_path import (
    _HEADER,
    call_of,
    dialled,
    dropped,
    ends,
    found,
    greeted,
    key_of,
    meet_again,
    server,
    taken,
)
from trade import Container, Handle, Resource, current_call, service, where
from trade.errors import TooLarge
from trade.protocol.messages import LARGE, MOST_BYTES, PROTOCOL
from trade.transport import local_greeting
from trade.transport.local_connection import LocalConnection
from trade.transport.local_greeting import Greeting
from trade.transport.shared_segment import SharedSegment

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="memfd_create")

_BIG = 300_000


class Studio:
    """Takes and gives what is large."""

    def __init__(self) -> None:
        self.resources = [Resource("lamp")]
        self.ran: list[int] = []
        self.views: list[memoryview] = []

    @service
    def echo(self, value: bytes) -> bytes:
        self.ran.append(len(value))
        return value

    @service
    def turn(self, first: bytes, times: int = 1, *, last: bytes = b"") -> tuple[bytes, int, bytes]:
        return last, times, first

    @service(effect="read")
    def any_of(self, value: Any) -> Any:
        return value

    @service(effect="read")
    def keep(self, picture: memoryview) -> int:
        self.views.append(picture)
        return len(picture)

    @service(effect="stop")
    def stop(self) -> None: ...

    @service(effect="read")
    def develop(self) -> bytes:
        for step in range(3):
            current_call().progress(bytes([step]) * _BIG)
        return b"z" * _BIG


@pytest.fixture(autouse=True)
def _switched_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRADE_LOCAL_PATH", "1")


@pytest.fixture
def studio() -> Studio:
    return Studio()


@pytest.fixture
def echo(here: Container, there: Container, studio: Studio) -> Handle:
    """A service whose connection has a segment that both ends use."""
    there.register(studio, "studio")
    handle = found(here, "echo")
    for _ in range(3):  # the first one finds that values are large, and the second one offers the segment
        assert len(handle(bytes(_BIG))) == _BIG
    studio.ran.clear()
    return handle


@pytest.fixture
def put(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The sizes of all payloads that take a segment."""
    sizes: list[int] = []
    send = SharedSegment.put

    def seen(self: SharedSegment, parts: Any) -> None:
        sizes.append(sum(map(len, parts)))
        send(self, parts)

    monkeypatch.setattr(SharedSegment, "put", seen)
    return sizes


def descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def descriptors_at_rest() -> int:
    """The least of several looks: containers look at their files and addresses now and then."""
    return min((descriptors(), time.sleep(0.01))[0] for _ in range(10))


def memory(size: int, *seals: int, kind: Callable[[], int] | None = None) -> int:
    """A descriptor of memory, or of something else."""
    if kind is not None:
        return kind()
    descriptor = os.memfd_create("test", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    os.ftruncate(descriptor, size)
    for seal in seals:
        fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, seal)
    return descriptor


_SEALED = (fcntl.F_SEAL_SHRINK, fcntl.F_SEAL_GROW)


def test_large_values_take_the_segment_both_ways_and_small_ones_do_not(echo: Handle, put: list[int]) -> None:
    for size in (0, 1, 1000, LARGE - 200, LARGE, 1 << 20):
        value = os.urandom(size)
        assert echo(value) == value
    assert len(put) == 4
    assert min(put) >= LARGE


def test_arguments_in_any_place_arrive_as_they_were_sent(here: Container, echo: Handle, put: list[int]) -> None:
    turn, any_of, a, b = found(here, "turn"), found(here, "any_of"), os.urandom(_BIG), os.urandom(LARGE)
    assert turn(a) == (b"", 1, a)
    assert turn(a, 2) == (b"", 2, a)
    assert turn(a, 2, last=b) == (b, 2, a)
    assert turn(first=a) == (b"", 1, a)
    for value in (a, [a, {"b": b}], "x" * _BIG, [b, b, b]):
        assert any_of(value) == value
    assert any_of(bytearray(a)) == a
    assert len(put) == 2 * 9


def test_the_token_of_a_lock_follows_a_large_argument(here: Container, echo: Handle, put: list[int]) -> None:
    value = os.urandom(_BIG)
    with here.lock(where(group="studio")):  # without its token, the call would be refused
        assert echo(value) == value
    assert len(put) == 2


def test_a_value_that_is_too_large_for_the_segment_takes_the_socket(echo: Handle, put: list[int]) -> None:
    value = os.urandom(9 << 20)
    assert echo(value) == value
    assert put == []
    assert len(echo(bytes(_BIG))) == _BIG
    assert len(put) == 2


@pytest.mark.parametrize("size", [MOST_BYTES - 5, MOST_BYTES + 1])
def test_the_limit_of_arguments_is_the_same(echo: Handle, studio: Studio, put: list[int], size: int) -> None:
    with pytest.raises(TooLarge):
        echo(bytes(size))
    assert (studio.ran, put) == ([], [])
    assert len(echo(bytes(_BIG))) == _BIG


def test_a_received_view_stays_as_it_came_and_the_sender_may_change_its_memory(
    here: Container, echo: Handle, studio: Studio, put: list[int]
) -> None:
    keep, picture = found(here, "keep"), bytearray(_BIG)
    for number in range(8):
        picture[:] = bytes([number]) * _BIG
        assert keep(picture) == _BIG
    picture[:] = b"x" * _BIG
    assert len(put) == 8
    assert [set(view) for view in studio.views] == [{number} for number in range(8)]


def test_large_progress_before_an_answer_overwrites_nothing(here: Container, echo: Handle, put: list[int]) -> None:
    develop, heard = found(here, "develop"), list[Any]()
    assert set(develop()) == {ord("z")}
    run = develop.start()
    run.on_progress(heard.append)
    assert set(run.result(20)) == {ord("z")}
    assert all(len(set(one)) == 1 for one in heard)
    assert put


def test_threads_each_get_their_own_values(echo: Handle, put: list[int]) -> None:
    wrong: list[int] = []

    def call(first: int) -> None:
        for value in range(first, first + 10):
            if set(echo(bytes([value]) * _BIG)) != {value}:
                wrong.append(value)

    threads = [threading.Thread(target=call, args=(index * 10,)) for index in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert wrong == []
    assert put


def test_a_connection_that_breaks_sends_a_large_call_again_on_the_transport(
    here: Container, there: Container, echo: Handle, studio: Studio, put: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    copy, broken = SharedSegment.copy_to, list[bool]()

    def breaks(self: SharedSegment, place: memoryview) -> None:
        if not broken:
            broken.append(True)
            for connection in list(server(there)._threads.values()):
                if connection is not None:
                    connection.break_off()
        copy(self, place)

    before, value = taken(there)[1], os.urandom(_BIG)
    monkeypatch.setattr(SharedSegment, "copy_to", breaks)
    assert echo(value) == value
    assert broken
    assert taken(there)[1] > before
    assert studio.ran == [_BIG]


def test_descriptors_and_mappings_are_released(here: Container, there: Container, echo: Handle, put: list[int]) -> None:
    def shared() -> int:
        return Path("/proc/self/maps").read_text().count("trade-calls")

    before = descriptors()
    assert shared() == 2  # both ends are in this process
    for _ in range(5):
        meet_again(here)
        assert len(echo(bytes(_BIG))) == _BIG
        wait_until(lambda: shared() == 2, "the old one is gone")
    wait_until(lambda: descriptors() <= before, "no descriptor is left")
    assert put
    there.close()
    wait_until(lambda: shared() == 0, "the memory is gone")


@pytest.fixture(params=["no memory here", "no memory there", "an older callee"])
def without(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Something that keeps two containers from sharing memory."""

    create, taken_by = os.memfd_create, SharedSegment.taken

    def full(name: str, *flags: int) -> int:
        if name == "trade-calls":
            raise OSError(24, "Too many open files")
        return create(name, *flags)

    if request.param == "no memory here":
        monkeypatch.setattr(os, "memfd_create", full)
    elif request.param == "no memory there":
        monkeypatch.setattr(SharedSegment, "taken", lambda fds, size: taken_by(fds, size) and None)  # mmap has failed
    else:  # the system closes what it does not receive
        monkeypatch.setattr(local_greeting, "_receive", _receive_bytes)
    yield request.param


def _receive_bytes(sock: socket.socket) -> tuple[bytes, list[int]]:
    return sock.recv(1), []


def test_without_shared_memory_large_values_take_the_socket(
    without: str, here: Container, there: Container, studio: Studio, put: list[int]
) -> None:
    there.register(studio, "studio")
    echo = found(here, "echo")
    echo(b"")  # requests the clock, too
    local, other = taken(there)
    for _ in range(6):
        value = os.urandom(_BIG)
        assert echo(value) == value
    assert put == []
    assert taken(there) == (local + 6, other)
    assert here._parts.local_path is not None
    assert len(here._parts.local_path.slots) == 1  # it is not opened again and again


def test_an_older_callee_understands_the_greeting() -> None:
    older = msgspec.defstruct(
        "Greeting", [("v", int), ("caller", Any), ("reply", str), ("stops", bool), ("proof", bytes)], array_like=True
    )
    greeting = Greeting(PROTOCOL, ("a", "b", "c"), "b/1", False, b"", False, 1 << 20)  # type: ignore[arg-type]
    read: Any = msgspec.msgpack.decode(msgspec.msgpack.encode(greeting), type=older)
    assert (read.reply, read.stops) == ("b/1", False)


def test_an_older_caller_is_answered_without_marks(here: Container, there: Container, echo: Handle) -> None:
    connection = greeted(there, here)
    call = msgspec.msgpack.decode(call_of(here))
    call[2], call[7] = "echo", [bytes(_BIG)]
    connection.send(msgspec.msgpack.encode(call), key=key_of(echo, here.address.identity))
    assert _HEADER.unpack(connection._sock.recv(_HEADER.size, socket.MSG_PEEK | socket.MSG_WAITALL))[1] == 0
    assert len(msgspec.msgpack.decode(connection.receive()[1])[4]) == _BIG
    connection.close()


def test_no_descriptor_left_means_the_socket(
    echo: Handle, here: Container, put: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    def none_left(*_: object) -> int:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    meet_again(here)
    monkeypatch.setattr(os, "memfd_create", none_left)
    assert len(echo(bytes(_BIG))) == _BIG
    assert put == []


def _pipe() -> int:
    reading, writing = os.pipe()
    os.close(writing)
    return reading


@pytest.mark.parametrize(
    ("passed", "announced"),
    [
        ([lambda: memory(1 << 20)], 1 << 20),
        ([lambda: memory(1 << 20, fcntl.F_SEAL_GROW)], 1 << 20),
        ([lambda: memory(1 << 19, *_SEALED)], 1 << 20),
        ([lambda: memory(1 << 20, *_SEALED)], 2 << 30),
        ([lambda: memory(0, *_SEALED)], 0),
        ([lambda: memory(1 << 20, *_SEALED)], 0),
        ([lambda: memory(1 << 20, *_SEALED)] * 2, 1 << 20),
        ([lambda: os.open("/etc/hostname", os.O_RDONLY)], 1 << 20),
        ([_pipe], 1 << 20),
        ([lambda: os.open("/dev/zero", os.O_RDWR)], 1 << 20),
    ],
    ids=["unsealed", "may shrink", "short", "2 GiB", "empty", "not announced", "two", "a file", "a pipe", "a device"],
)
def test_what_is_no_segment_ends_its_connection_only(
    here: Container,
    there: Container,
    echo: Handle,
    studio: Studio,
    passed: list[Callable[[], int]],
    announced: int,
) -> None:
    before, open_before = dropped(there), descriptors_at_rest()
    connection = offering(there, here, [make() for make in passed], announced)
    assert ends(connection, call_of(here), key_of(echo, here.address.identity))
    wait_until(lambda: dropped(there) == before + 1, "it is counted")
    wait_until(lambda: descriptors() <= open_before, "its descriptors are closed")
    assert studio.ran == []
    assert len(echo(bytes(_BIG))) == _BIG


def offering(container: Container, client: Container, passed: list[int], announced: int) -> LocalConnection:
    """A connection that offers these descriptors as its segment, and closes them."""
    passport = client._parts.local_path.passport  # type: ignore[union-attr]
    reply = f"{client.address.container}/{client.address.epoch}-local-forged"
    proof = passport._proof(client.address, container.address)
    greeting = msgspec.msgpack.encode(
        Greeting(PROTOCOL, client.address, reply, stops=False, proof=proof, segment_bytes=announced)
    )
    sock = dialled(container)
    socket.send_fds(sock, [_HEADER.pack(len(greeting), 0) + greeting], passed)
    for descriptor in passed:
        os.close(descriptor)
    return LocalConnection(sock)


@pytest.mark.parametrize("size", [0, LARGE - 1, (1 << 19) + 1, 64 << 20, 2 << 30])
def test_a_payload_that_the_segment_cannot_have_ends_the_connection(
    here: Container, there: Container, echo: Handle, studio: Studio, size: int
) -> None:
    before = dropped(there)
    connection = offering(there, here, [memory(1 << 20, *_SEALED)], 1 << 20)
    key = key_of(echo, here.address.identity)
    connection._sock.sendall(_HEADER.pack(size, len(key) | 0x8000) + key)
    assert ends(connection)
    wait_until(lambda: dropped(there) == before + 1, "it is counted")
    assert studio.ran == []
    assert len(echo(bytes(_BIG))) == _BIG


def test_a_mark_without_a_segment_ends_the_connection(
    here: Container, there: Container, echo: Handle, studio: Studio
) -> None:
    connection, key = greeted(there, here), key_of(echo, here.address.identity)
    connection._sock.sendall(_HEADER.pack(LARGE, len(key) | 0x8000) + key)
    assert ends(connection)
    assert studio.ran == []
    assert len(echo(bytes(_BIG))) == _BIG


def test_what_a_caller_writes_later_is_not_seen(
    here: Container, there: Container, echo: Handle, studio: Studio
) -> None:
    """A provider keeps a view, and the caller changes the shared memory afterwards."""
    made = SharedSegment.make()
    assert made is not None
    segment, descriptor = made
    connection = offering(there, here, [os.dup(descriptor)], segment.size_bytes)
    call = msgspec.msgpack.decode(call_of(here))
    call[2], call[7] = "keep", [b"a" * _BIG]
    data = msgspec.msgpack.encode(call)
    segment.put((data,))
    key = key_of(echo, here.address.identity)
    connection._sock.sendall(_HEADER.pack(len(data), len(key) | 0x8000) + key)
    wait_until(lambda: bool(studio.views), "it has run")
    segment.put((b"x" * len(data),))
    assert set(studio.views[0]) == {ord("a")}
    connection.close()
    segment.close()
    os.close(descriptor)


@pytest.mark.realtime
def test_a_forked_child_releases_the_memory(start_container: Any, start_program: Any, unwatched: str) -> None:
    there = start_container("there")
    there.register(Studio(), "studio")
    program = start_program(
        """
        container = Container(Settings.read(container="parent"))
        echo = container.find(where(name="echo", local=False), wait_s=20).with_(deadline_s=20)
        for _ in range(3): echo(bytes(300_000))
        def maps(): return open("/proc/self/maps").read().count("trade-calls")
        say(str(maps()))
        child = os.fork()
        if child == 0:
            os._exit(maps())
        say(str(os.waitpid(child, 0)[1]))
        say(str([len(echo(bytes(300_000))) for value in range(3)]))
        """,
        prelude=unwatched,
    )
    assert [program.heard() for _ in range(3)] == ["1", "0", "[300000, 300000, 300000]"]


@pytest.mark.realtime
def test_a_killed_callee_leaves_no_memory(here: Container, start_program: Any) -> None:
    program = start_program(
        """
        class Studio:
            @service
            def echo(self, value: bytes) -> bytes: return value
        container = Container(Settings.read(container="there"))
        container.register(Studio(), "studio")
        say("up")
        hear()
        """
    )
    assert program.heard() == "up"
    echo = found(here, "echo")
    for _ in range(3):
        assert len(echo(bytes(_BIG))) == _BIG
    assert "trade-calls" in Path("/proc/self/maps").read_text()
    program.kill()
    wait_until(lambda: "trade-calls" not in Path("/proc/self/maps").read_text(), "the memory is gone")


def test_with_certificates_large_values_take_the_segment(
    start_container: Any, tmp_path: Path, studio: Studio, put: list[int]
) -> None:
    papers = Papers(tmp_path / "pki")
    there = start_container("there", tls=papers.of("robot"))
    there.register(studio, "studio")
    echo = found(start_container("here", tls=papers.of("planner")), "echo")
    for _ in range(4):
        value = os.urandom(_BIG)
        assert echo(value) == value
    assert put
