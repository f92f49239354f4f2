"""The local path: calls within a host go directly, and whatever goes wrong there ends as it does on the transport."""

import _thread
import errno
import os
import signal
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import pytest

from tests.support.certificates import Papers
from tests.support.waiting import wait_until
from tests.unit.trade.conftest import Gate
from trade import Container, Handle, Resource, Run, current_call, errors, service, where
from trade._calls import local_path
from trade._paths import runtime_folder
from trade._resources.lock_table import LockTable
from trade._security.certificates import Certificate
from trade._services import local_server
from trade._services.dispatcher import Dispatcher
from trade._services.local_server import Keys, LocalChannel, LocalReplier, LocalServer
from trade.protocol.keys import ALIVE, Address, alive_key, call_key
from trade.protocol.messages import PROTOCOL, decode_call, decode_reply
from trade.transport import local_connection, local_greeting
from trade.transport.base import ChannelClosed, Message
from trade.transport.host_socket import _short, dial_on_host
from trade.transport.local_connection import ConnectionEnded, LocalConnection
from trade.transport.local_greeting import Greeting, Passport

_HEADER = struct.Struct("<IH")
needs_pidfd = pytest.mark.skipif(not hasattr(os, "pidfd_open"), reason="Linux reports the end of a process")


class Axis:
    """A joint that can be locked."""

    def __init__(self, name: str) -> None:
        self.resources = [Resource(name)]

    @service
    def move(self, goal: int) -> int:
        return goal

    @service(effect="stop")
    def stop(self) -> None: ...


class Arm:
    """A provider with every kind of service and error."""

    def __init__(self) -> None:
        self.ran: list[int] = []

    @service
    def add(self, a: int, b: int = 1) -> int:
        self.ran.append(a)
        return a + b

    @service(effect="read")
    def echo(self, value: bytes) -> bytes:
        return value

    @service(effect="read")
    def who(self) -> str:
        return current_call().caller

    @service
    def fail(self) -> None:
        raise KeyError("no such joint")

    @service
    def lie(self) -> int:
        return "none"  # type: ignore[return-value]

    @service(effect="read")
    def report(self) -> int:
        for step in range(3):
            current_call().progress(step)
        return 3

    @service(effect="stop")
    def stop(self) -> str:
        return "stopped"


@pytest.fixture(autouse=True)
def _switched_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRADE_LOCAL_PATH", "1")


@pytest.fixture
def arm() -> Arm:
    return Arm()


@pytest.fixture
def add(here: Container, there: Container, arm: Arm) -> Handle:
    """A service of another container, which has answered on the local path."""
    there.register(arm, "robot")
    handle = found(here, "add")
    assert handle(1) == 2
    return handle


def found(container: Container, name: str) -> Handle:
    return container.find(where(name=name, local=False), wait_s=20).with_(deadline_s=20)


def server(container: Container) -> LocalServer:
    return next(pool for pool in container._parts.dispatcher.pools if isinstance(pool, LocalServer))


def meet_again(container: Container) -> None:
    """Closes its free connections to others, as if it had just met them."""
    for peer in container._parts.caller._peers.values():
        assert peer.local is not None
        peer.close()
        peer.local._closed = False
        peer.local._not_before_s = 0.0


def break_off_all(container: Container) -> None:
    """Breaks all connections to a container."""
    for connection in list(server(container)._threads.values()):
        if connection is not None:
            connection.break_off()


def taken(container: Container) -> tuple[int, int]:
    """How many calls it has taken: on the local path, and on the transport."""
    pools = list(container._parts.dispatcher.pools)
    local = sum(pool.taken for pool in pools if isinstance(getattr(pool, "_channel", pool), LocalServer | LocalChannel))
    return local, sum(pool.taken for pool in pools) - local


def place(container: Container) -> Path:
    """The socket where a container takes local calls."""
    return next((runtime_folder() / container.settings.system).glob(f".calls-*-{container.address.epoch}"))


def dialled(container: Container) -> socket.socket:
    sock = dial_on_host(place(container), 20)
    sock.settimeout(20)
    return sock


def greeted(container: Container, client: Container, /, **changes: Any) -> LocalConnection:
    """A connection whose greeting differs from the right one."""
    passport = client._parts.local_path.passport  # type: ignore[union-attr]
    fields: dict[str, Any] = {
        "v": PROTOCOL,
        "caller": client.address,
        "reply": f"{client.address.container}/{client.address.epoch}-local-forged",
        "stops": False,
        "proof": passport._proof(client.address, container.address),
        **changes,
    }
    connection = LocalConnection(dialled(container))
    connection.send(msgspec.msgpack.encode(Greeting(**fields)))
    return connection


def ends(connection: LocalConnection, payload: bytes = b"", key: bytes = b"") -> bool:
    """Whether the other end closes a connection without an answer to this message."""
    try:
        with pytest.raises(ConnectionEnded):
            if payload:
                connection.send(payload, key=key)
            connection.receive()
    finally:
        connection.close()
    return True


@contextmanager
def without_threads(name: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """No thread of this name can be started."""
    start = threading.Thread.start

    def refuse(thread: threading.Thread) -> None:
        if thread.name == name:
            raise RuntimeError("can't start new thread")
        start(thread)

    with monkeypatch.context() as full:
        full.setattr(threading.Thread, "start", refuse)
        yield


@contextmanager
def mute_socket(path: Path) -> Iterator[None]:
    """A socket that answers nothing is in the place of a container's."""
    path.unlink()
    with socket.socket(socket.AF_UNIX) as mute:
        with _short(path) as name:
            mute.bind(name)
        mute.listen(8)
        yield


def run_all(threads: Sequence[threading.Thread]) -> None:
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)


def test_a_call_that_is_waited_for_takes_the_local_path(there: Container, add: Handle) -> None:
    local, other = taken(there)
    assert [add(value) for value in range(20)] == list(range(1, 21))
    assert taken(there) == (local + 20, other)


def test_started_calls_share_a_connection(here: Container, there: Container, add: Handle) -> None:
    local, other = taken(there)
    runs = [add.start(value) for value in range(50)]
    assert [run.result(20) for run in runs] == list(range(1, 51))
    assert taken(there) == (local + 50, other)
    assert here._parts.local_path is not None
    assert len(here._parts.local_path.slots) == 2  # and that of calls that are waited for


def test_a_started_call_that_takes_longer_than_before_keeps_no_other_waiting(
    here: Container, there: Container, add: Handle, gate: Gate
) -> None:
    there.register(gate, "gate")
    enter = found(here, "pass_through")
    gate.open.set()
    assert {run.result(20) for run in [enter.start() for _ in range(50)]} == {"through"}
    gate.open.clear()
    inside = list[Run]()
    for value in range(60):
        behind = [add.start(value) for _ in range(10)]
        if value % 3 == 0:
            inside.append(enter.start())
        assert [run.result(20) for run in behind] == [value + 1] * 10
    wait_until(lambda: gate.runs == 50 + len(inside), "they are inside")
    assert not any(run.done() for run in inside)
    gate.open.set()
    assert {run.result(20) for run in inside} == {"through"}


@pytest.fixture
def answers_then_hangs_up(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Names of services of locks: each answer to one is followed at once by the end of its connection."""
    last, named, ending = threading.local(), set[str](), set[int]()
    serve, send, receive = Dispatcher.serve, LocalReplier.put, LocalConnection.receive

    def served(self: Dispatcher, message: Message, *args: Any, **kwargs: Any) -> None:
        last.service = decode_call(message.payload or b"").service
        serve(self, message, *args, **kwargs)

    def sent(self: LocalReplier, payload: bytes) -> None:
        if last.service not in named:
            send(self, payload)
            return
        ending.add(decode_reply(payload).id)
        send(self, payload)
        self.close()

    def received(self: LocalConnection, *most: int) -> tuple[bytes, bytes]:
        """As a process reads it that was frozen meanwhile."""
        key, payload = receive(self, *most)
        if ending and not (key or most) and decode_reply(payload).id in ending:  # an answer, no greeting
            wait_until(lambda: self.ended_there, "the other end has ended it")
        return key, payload

    monkeypatch.setattr(Dispatcher, "serve", served)
    monkeypatch.setattr(LocalReplier, "put", sent)
    monkeypatch.setattr(LocalConnection, "receive", received)
    return named


@pytest.mark.parametrize("shared", [False, True], ids=["waited for", "started"])
def test_a_grant_on_a_connection_that_has_ended_is_not_taken(
    start_container: Any, here: Container, there: Container, answers_then_hangs_up: set[str], shared: bool
) -> None:
    """A callee that has lost this container ends its connections first, and then its locks."""
    there.register(Axis("a"), "robot")
    found(here, "move")
    if shared:  # a lock over two containers starts the second request
        third = start_container("third")
        third.register(Axis("b"), "robot")
        wait_until(lambda: len(here.services(where(name="move"))) == 2, "both are seen")
    answers_then_hangs_up.add("acquire")
    lock = here.lock(where(group="robot"), lease_s=0.5)
    with pytest.raises(errors.ContainerLost):
        lock.acquire()
    assert not lock.held
    answers_then_hangs_up.clear()
    with here.lock(where(group="robot"), wait_s=20) as again:  # the lease of the unused grant has ended
        assert again.held


def test_a_renewal_on_a_connection_that_has_ended_loses_the_lock(
    here: Container, there: Container, answers_then_hangs_up: set[str]
) -> None:
    there.register(Axis("a"), "robot")
    found(here, "move")
    lost: list[errors.LockLost] = []
    with pytest.raises(errors.LockLost), here.lock(where(group="robot"), lease_s=0.5, on_lost=lost.append) as lock:
        answers_then_hangs_up.add("renew")
        wait_until(lambda: lost, "it is lost")
        assert not lock.held
        lock.check()


def test_a_callee_ends_the_connections_of_a_lost_container_before_its_locks(
    here: Container, there: Container, add: Handle, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert here._parts.local_path is not None
    ended: list[bool] = []
    session_ended = LockTable.session_ended

    def seen(self: LockTable, session: str, reason: str) -> None:
        ended.append(all(slot.connection.ended_there for slot in here._parts.local_path.slots))  # type: ignore[union-attr]
        session_ended(self, session, reason)

    monkeypatch.setattr(LockTable, "session_ended", seen)
    assert not any(slot.connection.ended_there for slot in here._parts.local_path.slots)
    there._parts._lost(here.address)
    assert ended == [True]


def test_a_call_does_not_overtake_the_started_ones_before_it(
    here: Container, there: Container, add: Handle, gate: Gate
) -> None:
    class Press:
        def __init__(self) -> None:
            self.ran: list[int] = []

        @service(serial=True)
        def press(self, value: int) -> None:
            self.ran.append(value)

    machine = Press()
    there.register(machine, "press")
    press = found(here, "press")
    press.start(0)
    for value in range(1, 199, 2):
        press.start(value)
        press(value + 1)
    late = sum(first > second for first, second in zip(machine.ran, machine.ran[1:], strict=False))
    assert sorted(machine.ran) == list(range(199))
    assert late < 20  # two threads of the callee may begin in either order, but the way there keeps it


def test_a_callback_of_a_started_call_may_call_and_wait(
    here: Container, there: Container, add: Handle, gate: Gate
) -> None:
    there.register(gate, "gate")
    waiting = found(here, "pass_through").start()
    assert gate.entered.wait(20)
    answers: list[int] = []
    ended = threading.Event()

    def call(_: object) -> None:
        add.start(10)
        answers.append(add(1))
        ended.set()

    run = add.start(0)
    run.add_done_callback(call)
    assert ended.wait(20)
    assert answers == [2]
    gate.open.set()
    waiting.result(20)


def test_a_stop_can_be_started(here: Container, there: Container, add: Handle) -> None:
    local, other = taken(there)
    assert found(here, "stop").start().result(20) == "stopped"
    assert taken(there) == (local + 1, other)


def test_progress_of_a_started_call_arrives(here: Container, there: Container, add: Handle) -> None:
    run = found(here, "report").start()
    heard: list[Any] = []
    run.on_progress(heard.append)
    assert run.result(20) == 3
    assert set(heard) <= {0, 1, 2}


def test_a_started_call_is_cancelled(here: Container, there: Container, add: Handle) -> None:
    class Patient:
        def __init__(self) -> None:
            self.entered = threading.Event()

        @service
        def wait(self) -> None:
            self.entered.set()
            if current_call().wait_cancelled(30):
                raise errors.Cancelled(service="wait")

    patient = Patient()
    there.register(patient, "bed")
    run = found(here, "wait").start()
    assert patient.entered.wait(20)
    run.cancel()
    assert isinstance(run.exception(20), errors.Cancelled)


def test_started_calls_whose_connection_breaks_end_on_the_transport_and_run_once(
    here: Container, there: Container, add: Handle, gate: Gate, arm: Arm
) -> None:
    there.register(gate, "gate")
    arm.ran.clear()
    waiting, runs = found(here, "pass_through").start(), [add.start(value) for value in range(20)]
    assert gate.entered.wait(20)
    break_off_all(there)
    runs += [add.start(value) for value in range(20, 40)]
    gate.open.set()
    assert waiting.result(20) == "through"
    assert [run.result(20) for run in runs] == list(range(1, 41))
    assert sorted(arm.ran) == list(range(40))


def test_a_stop_takes_the_local_path_on_a_connection_of_its_own(here: Container, there: Container, add: Handle) -> None:
    stop = found(here, "stop")
    mine = (here.address.identity, True)
    before = server(there)._connections[mine]
    local, other = taken(there)
    assert stop() == "stopped"
    assert taken(there) == (local + 1, other)
    assert server(there)._connections[mine] == before + 1


@pytest.mark.parametrize("off", ["here", "there"])
def test_a_container_without_it_is_called_on_the_transport(
    start_container: Any, arm: Arm, off: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def start(name: str) -> Container:
        monkeypatch.setenv("TRADE_LOCAL_PATH", "0" if name == off else "1")
        container: Container = start_container(name)
        return container

    here, there = start("here"), start("there")
    there.register(arm, "robot")
    assert [found(here, "add")(value) for value in range(3)] == [1, 2, 3]
    assert taken(there)[0] == 0
    assert taken(there)[1] >= 3


def test_without_it_a_started_call_leaves_nothing_behind(
    start_container: Any, gate: Gate, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TRADE_LOCAL_PATH", "0")
    here, there = start_container("here"), start_container("there")
    there.register(gate, "gate")
    run = found(here, "pass_through").start()
    assert gate.entered.wait(20)
    assert not any(peer.unarrived for peer in here._parts.caller._peers.values())
    gate.open.set()
    run.result(20)


def test_large_values_pass_whole(here: Container, add: Handle) -> None:
    echo = found(here, "echo")
    for size in (0, 1, 32 << 10, (32 << 10) + 1, (64 << 10) - 100, 64 << 10, (64 << 10) + 1, 3 << 20):
        value = os.urandom(size)
        assert echo(value) == value


def test_a_large_argument_that_is_kept_as_a_view_stays_as_it_came(here: Container, there: Container) -> None:
    class Album:
        def __init__(self) -> None:
            self.views: list[memoryview] = []

        @service(effect="read")
        def keep(self, picture: memoryview) -> int:
            self.views.append(picture)
            return len(picture)

    album = Album()
    there.register(album, "album")
    keep = found(here, "keep")
    for number in range(8):
        assert keep(bytes([number]) * 300_000) == 300_000
    assert [set(view) for view in album.views] == [{number} for number in range(8)]
    album.views.clear()
    kept = {id(place) for place in local_connection._kept}
    for _ in range(8):
        keep(b"x" * 300_000)
        album.views.clear()
    assert {id(place) for place in local_connection._kept} == kept  # used again


def test_many_callers_at_once_each_get_their_own_answer(there: Container, add: Handle) -> None:
    wrong: list[object] = []

    def call(first: int) -> None:
        for value in range(first, first + 20):
            answer = add(value)
            if answer != value + 1:
                wrong.append((value, answer))

    threads = [threading.Thread(target=call, args=(index * 1000,)) for index in range(24)]
    run_all(threads)
    assert not wrong
    assert taken(there)[0] > 24 * 20


def test_free_connections_are_few(there: Container, add: Handle, gate: Gate, here: Container) -> None:
    there.register(gate, "gate")
    enter = found(here, "pass_through")
    threads = [threading.Thread(target=enter) for _ in range(50)]
    for thread in threads:
        thread.start()
    wait_until(lambda: server(there).working == 50, "all are inside")
    gate.open.set()
    for thread in threads:
        thread.join(20)
    wait_until(lambda: len(server(there)._threads) <= 33, "the rest is closed")
    assert add(1) == 2


def test_progress_is_passed_over_by_a_caller_that_waits(here: Container, add: Handle) -> None:
    assert found(here, "report")() == 3
    assert add(1) == 2


def test_a_caller_waits_for_none_of_the_serial_calls_behind_its_own(
    here: Container, there: Container, add: Handle
) -> None:
    class Press:
        def __init__(self) -> None:
            self.entered = [threading.Event(), threading.Event()]
            self.open = [threading.Event(), threading.Event()]

        @service(serial=True)
        def press(self, index: int) -> int:
            self.entered[index].set()
            assert self.open[index].wait(30)
            return index

    machine = Press()
    there.register(machine, "press")
    press = found(here, "press")
    answers: list[int] = []

    def call() -> None:
        answers.append(press(0))
        answers.append(add(1))  # on the connection of the call before it

    first, second = threading.Thread(target=call), threading.Thread(target=lambda: press(1))
    first.start()
    assert machine.entered[0].wait(20)
    second.start()
    wait_until(lambda: there._parts.providers.waiting() == 1, "the second one is queued")
    machine.open[0].set()
    first.join(20)
    assert answers == [0, 2]
    machine.open[1].set()
    second.join(20)


@pytest.fixture(params=["local path", "transport"])
def robot(
    request: pytest.FixtureRequest, start_container: Any, arm: Arm, monkeypatch: pytest.MonkeyPatch
) -> tuple[Container, Container]:
    """A container that calls and one that provides, on either path."""
    monkeypatch.setenv("TRADE_LOCAL_PATH", "1" if request.param == "local path" else "0")
    here, there = start_container("here"), start_container("there")
    there.register(arm, "robot")
    assert found(here, "add")(5) == 6
    assert bool(taken(there)[0]) is (request.param == "local path")
    arm.ran.clear()
    return here, there


@pytest.mark.parametrize(
    ("name", "argument", "error"),
    [
        ("fail", [], KeyError),
        ("lie", [], errors.InvalidResult),
        ("add", ["one"], errors.InvalidArgument),
        ("add", [object()], errors.NotSerialisable),
        ("echo", [bytes(65 << 20)], errors.TooLarge),
    ],
    ids=["provider", "result", "argument", "unsendable", "large"],
)
def test_an_error_is_the_same_on_either_path(
    robot: tuple[Container, Container], arm: Arm, name: str, argument: list[Any], error: type[Exception]
) -> None:
    here, _ = robot
    with pytest.raises(error):
        found(here, name)(*argument)
    assert arm.ran == []
    assert found(here, "add")(1) == 2


def test_a_deadline_ends_the_wait_and_the_outcome_is_unknown(robot: tuple[Container, Container], gate: Gate) -> None:
    here, there = robot
    there.register(gate, "gate")
    began = time.monotonic()
    with pytest.raises(errors.OutcomeUnknown):
        found(here, "pass_through").with_(deadline_s=0.2)()
    assert time.monotonic() - began >= 0.2
    assert found(here, "add")(1) == 2


def test_a_service_that_is_gone_says_so(robot: tuple[Container, Container], arm: Arm) -> None:
    here, there = robot
    add = found(here, "add")
    there.deregister(arm)
    with pytest.raises(errors.ServiceGone):
        add(1)
    assert arm.ran == []


def test_a_lock_of_another_keeps_a_call_out(robot: tuple[Container, Container], arm: Arm, start_container: Any) -> None:
    here, _ = robot
    other = start_container("other")
    other.find(where(name="add", local=False), wait_s=20)
    with other.lock(where(group="robot")), pytest.raises(errors.LockedByOther):
        found(here, "add")(1)
    assert arm.ran == []
    with here.lock(where(group="robot")):
        assert found(here, "add")(1) == 2


def test_a_container_at_its_cap_is_busy(
    robot: tuple[Container, Container], gate: Gate, monkeypatch: pytest.MonkeyPatch
) -> None:
    here, there = robot
    monkeypatch.setattr("trade._threads.channel_workers.MOST_THREADS", 4)
    monkeypatch.setattr(local_server, "MOST_THREADS", 3)
    there.register(gate, "gate")
    enter, stop = found(here, "pass_through"), found(here, "stop")
    threads = [threading.Thread(target=enter) for _ in range(3)]
    for thread in threads:
        thread.start()
    wait_until(lambda: sum(pool.working for pool in there._parts.dispatcher.pools) >= 3, "they are inside")
    with pytest.raises(errors.Busy):
        enter()
    assert stop() == "stopped"
    gate.open.set()
    for thread in threads:
        thread.join(20)


@pytest.mark.realtime
def test_a_callee_that_closes_ends_the_wait(robot: tuple[Container, Container], gate: Gate) -> None:
    here, there = robot
    there.register(gate, "gate")
    enter, ended = found(here, "pass_through"), list[BaseException]()

    def call() -> None:
        try:
            enter()
        except BaseException as error:  # noqa: BLE001 - it is compared below
            ended.append(error)

    thread = threading.Thread(target=call)
    thread.start()
    assert gate.entered.wait(20)
    there.close()
    thread.join(20)
    gate.open.set()
    assert [type(error) for error in ended] == [errors.ContainerLost]


def test_an_interrupt_ends_the_wait_and_harms_no_later_call(robot: tuple[Container, Container], gate: Gate) -> None:
    here, there = robot
    there.register(gate, "gate")
    enter, add = found(here, "pass_through"), found(here, "add")

    def interrupt() -> None:
        assert gate.entered.wait(20)
        _thread.interrupt_main(signal.SIGINT)
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)  # type: ignore[arg-type]

    thread = threading.Thread(target=interrupt)
    thread.start()
    with pytest.raises(KeyboardInterrupt):
        enter()
    thread.join(20)
    assert [add(value) for value in range(5)] == [1, 2, 3, 4, 5]


@pytest.mark.realtime
@pytest.mark.parametrize("path", ["1", "0"])
def test_a_callee_that_is_killed_ends_the_wait_long_before_the_deadline(
    start_container: Any, start_program: Any, monkeypatch: pytest.MonkeyPatch, path: str
) -> None:
    monkeypatch.setenv("TRADE_LOCAL_PATH", path)
    here = start_container("here")
    program = start_program(_SLEEPER)
    assert program.heard() == "up"
    rest = found(here, "rest")
    kill = threading.Timer(0.3, program.kill)
    kill.start()
    with pytest.raises(errors.ContainerLost):
        rest()
    kill.join()


_SLEEPER = """
import time
class Sleeper:
    def __init__(self): self.ran = 0
    @service
    def rest(self) -> None:
        time.sleep(30)
    @service
    def count(self) -> int:
        self.ran += 1
        return self.ran
container = Container(Settings.read(container="there"))
container.register(Sleeper(), "bed")
say("up")
hear()
"""


@pytest.mark.realtime
@pytest.mark.parametrize("path", ["1", "0"])
def test_a_frozen_callee_ends_the_wait_and_runs_the_call_once_at_most(
    start_container: Any, start_program: Any, monkeypatch: pytest.MonkeyPatch, path: str
) -> None:
    monkeypatch.setenv("TRADE_LOCAL_PATH", path)
    here = start_container("here")
    program = start_program(_SLEEPER)
    assert program.heard() == "up"
    count = found(here, "count")
    assert count() == 1
    program.freeze()
    for _ in range(3):
        with pytest.raises(errors.OutcomeUnknown):
            count.with_(deadline_s=0.2)()
    program.thaw()
    wait_until(lambda: found(here, "count")() >= 2, "it answers again")
    assert count() <= 6


def test_a_call_whose_connection_breaks_ends_on_the_transport_and_runs_once(
    here: Container, there: Container, add: Handle, gate: Gate
) -> None:
    there.register(gate, "gate")
    wait_until(lambda: add(1) == 2 and taken(there)[0] > 0, "its connection is open")
    results: list[str] = []
    before = taken(there)[1]
    thread = threading.Thread(target=lambda: results.append(found(here, "pass_through")()))
    thread.start()
    assert gate.entered.wait(20)
    break_off_all(there)
    wait_until(lambda: taken(there)[1] > before, "it is asked again")
    gate.open.set()
    thread.join(20)
    assert results == ["through"]
    assert gate.runs == 1
    assert add(1) == 2


def test_a_users_service_of_the_name_of_one_of_locks_is_asked_again_too(
    here: Container, there: Container, add: Handle, gate: Gate
) -> None:
    class Library:
        @service
        def renew(self) -> str:
            gate.pass_through()
            return "renewed"

    there.register(Library(), "library")
    run = here.find(where(name="renew", group="library"), wait_s=20).with_(deadline_s=20).start()
    assert gate.entered.wait(20)
    break_off_all(there)
    wait_until(lambda: taken(there)[1] > 0, "it is asked again")
    gate.open.set()
    assert run.result(20) == "renewed"
    assert add(1) == 2


def test_answers_that_come_after_their_wait_are_not_taken_for_others(
    here: Container, there: Container, add: Handle, gate: Gate
) -> None:
    there.register(gate, "gate")
    for _ in range(3):
        with pytest.raises(errors.OutcomeUnknown):
            found(here, "pass_through").with_(deadline_s=0.05)()
    gate.open.set()
    assert [add(value) for value in range(10)] == list(range(1, 11))


def test_an_answer_after_the_end_goes_nowhere_though_the_number_of_the_socket_is_used_again() -> None:
    end, other = socket.socketpair()
    number = end.fileno()
    connection = LocalConnection(end)
    replier = LocalReplier(connection)
    replier.end()
    connection.close()
    near, far = socket.socketpair()
    with other, near, far:
        used_again = near.fileno() == number
        if not used_again:
            os.dup2(near.fileno(), number)
        replier.put(b"an answer")
        replier.close()
        connection.hang_up()
        far.setblocking(False)
        with pytest.raises(BlockingIOError):  # neither bytes nor an end
            far.recv(100)
        if not used_again:
            os.close(number)


def test_a_channel_that_closes_while_no_thread_receives_has_ended() -> None:
    end, other = socket.socketpair()
    with other:
        connection = LocalConnection(end)
        channel = LocalChannel(connection, Keys("here", stops=False))
        channel.close()
        assert channel.ended.is_set()
        with pytest.raises(ChannelClosed):
            channel.receive()
        connection.close()


def test_a_channel_that_closes_ends_the_thread_that_receives() -> None:
    end, other = socket.socketpair()
    with other:
        connection = LocalConnection(end)
        channel = LocalChannel(connection, Keys("here", stops=False))
        ended: list[ChannelClosed] = []

        def receive() -> None:
            try:
                channel.receive()
            except ChannelClosed as closed:
                ended.append(closed)

        thread = threading.Thread(target=receive)
        thread.start()
        wait_until(channel._receiving.locked, "it receives")
        channel.close()
        thread.join(20)
        assert ended
        connection.close()


def test_a_lost_container_closes_its_connections(here: Container, there: Container, add: Handle) -> None:
    assert here._parts.local_path is not None
    assert here._parts.local_path.slots
    there.close()
    wait_until(lambda: not here._parts.local_path.slots, "they are closed")  # type: ignore[union-attr]
    assert not list((runtime_folder() / here.settings.system).glob(f".calls-*-{there.address.epoch}"))


def dropped(container: Container) -> int:
    return container._parts.dispatcher.malformed


@pytest.mark.parametrize(
    "changes",
    [
        {"v": PROTOCOL + 1},
        {"proof": b""},
        {"proof": bytes(32)},
        {"reply": "another/1"},
        {"reply": "here"},
        {"caller": ("*", "here", "1")},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_a_greeting_that_proves_nothing_is_refused(
    here: Container, there: Container, add: Handle, arm: Arm, changes: dict[str, Any]
) -> None:
    arm.ran.clear()
    before = dropped(there)
    connection = greeted(there, here, **changes)
    assert ends(connection, call_of(here), key_of(add, here.address.identity))
    wait_until(lambda: dropped(there) == before + 1, "it is counted")
    assert arm.ran == []
    assert add(1) == 2


def key_of(handle: Handle, caller: str) -> bytes:
    """The key on which an identity calls a service's provider."""
    key = handle.key
    return call_key(caller, key.address, key.domain, key.provider, stop=False).encode()


def call_of(caller: Container) -> bytes:
    call = caller._parts.caller.new_call("add", msgspec.Raw(msgspec.msgpack.encode([41])))
    call.reply = f"{caller.address.container}/{caller.address.epoch}-local-forged"
    call.expires_ns = time.monotonic_ns() + 20_000_000_000
    return msgspec.msgpack.encode(call)


def test_a_connection_makes_calls_of_its_own_identity_only(
    here: Container, there: Container, add: Handle, arm: Arm
) -> None:
    arm.ran.clear()
    connection = greeted(there, here)
    assert ends(connection, call_of(here), key_of(add, "guest"))
    assert arm.ran == []
    connection = greeted(there, here)
    connection.send(call_of(here), key=key_of(add, here.address.identity))
    assert msgspec.msgpack.decode(connection.receive()[1])[4] == 42
    connection.close()
    assert arm.ran == [41]


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x00",
        _HEADER.pack(2 << 30, 0),
        _HEADER.pack(10, 60_000),
        _HEADER.pack(10, 0) + b"nonsense??",
        _HEADER.pack(1 << 20, 0) + b"half of it",
        b"GET / HTTP/1.1\r\n\r\n",
    ],
    ids=["silence", "a byte", "2 GiB", "a long key", "nonsense", "half a frame", "http"],
)
def test_a_stranger_that_sends_anything_is_dropped_in_a_moment(
    there: Container, add: Handle, data: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(local_greeting, "_ANSWER_S", 0.1)
    with dialled(there) as stranger:
        stranger.sendall(data)
        assert add(1) == 2
        assert stranger.recv(1) == b""
    wait_until(lambda: None not in list(server(there)._threads.values()), "no thread has a connection without a caller")
    assert add(1) == 2


@pytest.mark.parametrize("data", [_HEADER.pack(2 << 30, 0), _HEADER.pack(3, 3) + b"abcdef"], ids=["2 GiB", "a key"])
def test_nonsense_of_a_proven_container_ends_its_connection_only(
    here: Container, there: Container, add: Handle, data: bytes
) -> None:
    before = dropped(there)
    connection = greeted(there, here)
    connection._sock.sendall(data)
    assert ends(connection)
    wait_until(lambda: dropped(there) == before + 1, "it is counted")
    assert add(1) == 2


def test_a_payload_that_is_no_call_is_counted_and_answered_by_nothing(
    here: Container, there: Container, add: Handle
) -> None:
    before = dropped(there)
    connection = greeted(there, here)
    connection.send(b"nonsense", key=key_of(add, here.address.identity))
    wait_until(lambda: dropped(there) == before + 1, "it is counted")
    connection.close()
    assert add(1) == 2


def test_more_connections_than_it_takes_go_to_the_transport(
    here: Container, there: Container, add: Handle, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(local_server, "_MOST_FOR_CALLS", 0)
    stop = found(here, "stop")
    meet_again(here)
    wait_until(lambda: not server(there)._threads, "no connection is left")
    local, other = taken(there)
    assert [add(value) for value in range(5)] == [1, 2, 3, 4, 5]
    assert taken(there) == (local, other + 5)
    assert stop() == "stopped"


@pytest.mark.parametrize("what", ["nothing", "a file", "a deaf socket"])
def test_what_is_in_the_place_of_a_socket_does_not_matter(
    start_container: Any, arm: Arm, what: str, request: pytest.FixtureRequest
) -> None:
    there = start_container("there")
    there.register(arm, "robot")
    path = place(there)
    path.unlink()
    if what == "a file":
        path.write_text("nonsense")
    if what == "a deaf socket":
        deaf = socket.socket(socket.AF_UNIX)
        request.addfinalizer(deaf.close)
        with _short(path) as name:
            deaf.bind(name)
    here = start_container("here")
    assert [found(here, "add")(value) for value in range(3)] == [1, 2, 3]
    assert taken(there)[0] == 0


def test_a_socket_without_answers_costs_no_more_than_the_deadline(start_container: Any, arm: Arm) -> None:
    there = start_container("there")
    there.register(arm, "robot")
    with mute_socket(place(there)):
        here = start_container("here")
        add = found(here, "add")
        with pytest.raises((errors.OutcomeUnknown, errors.DeadlineExceeded)):
            add.with_(deadline_s=0.3)(1)
        assert arm.ran == []


@pytest.mark.realtime
@pytest.mark.skipif(os.getuid() != 0, reason="only root can become another user")
def test_another_users_socket_is_not_called(start_container: Any, arm: Arm, start_program: Any) -> None:
    there = start_container("there")
    there.register(arm, "robot")
    path = place(there)
    path.unlink()
    program = start_program(
        """
        import os, socket
        os.chdir(sys.argv[1])
        server = socket.socket(socket.AF_UNIX)
        os.setresuid(65534, 65534, 0)
        os.setresuid(-1, 0, -1)
        server.bind(sys.argv[2])
        os.setresuid(65534, 65534, 65534)
        server.listen(8)
        say("up")
        server.settimeout(20)
        end, _ = server.accept()
        say("got", str(len(end.recv(1000))))
        """,
        str(path.parent),
        path.name,
    )
    assert program.heard() == "up"
    here = start_container("here")
    assert found(here, "add")(1) == 2
    assert taken(there)[0] == 0
    assert program.heard() == "got 0"


@pytest.mark.realtime
def test_sockets_of_ended_processes_are_taken_away(system: str, start_container: Any, start_program: Any) -> None:
    program = start_program('container = Container(Settings.read(container="dead"))\nsay("up")\nhear()')
    assert program.heard() == "up"
    folder = runtime_folder() / system
    [left] = folder.glob(".calls-*")
    program.kill()
    assert left.exists()
    start_container("next")
    assert not left.exists()


def test_a_container_that_cannot_open_its_socket_says_so_and_takes_calls_on_the_transport(
    system: str, start_container: Any, arm: Arm, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    bind = socket.socket.bind

    def refuse(sock: socket.socket, place: Any) -> None:
        if sock.family == socket.AF_UNIX:
            raise OSError(28, "No space left on device")
        bind(sock, place)

    with monkeypatch.context() as full:
        full.setattr(socket.socket, "bind", refuse)
        there = start_container("there")
    assert "no local path here" in caplog.text
    there.register(arm, "robot")
    assert found(start_container("here"), "add")(1) == 2
    assert taken(there) == (0, taken(there)[1])


@pytest.mark.realtime
def test_a_caller_without_descriptors_still_calls(start_container: Any, start_program: Any, arm: Arm) -> None:
    there = start_container("there")
    there.register(arm, "robot")
    program = start_program(
        """
        import os, resource
        container = Container(Settings.read(container="poor"))
        add = container.find(where(name="add", local=False), wait_s=20).with_(deadline_s=20)
        add(1)
        for peer in container._parts.caller._peers.values():
            peer.close()
            peer.local._closed = False
        resource.setrlimit(resource.RLIMIT_NOFILE, (4096, 4096))
        taken = []
        try:
            while True: taken.append(os.open("/dev/null", os.O_RDONLY))
        except OSError: pass
        say(str([add(value) for value in range(5)]))
        """
    )
    assert program.heard() == "[1, 2, 3, 4, 5]"


@pytest.mark.realtime
def test_a_callee_without_descriptors_is_called_on_the_transport(start_container: Any, start_program: Any) -> None:
    program = start_program(
        """
        import os, resource
        class Poor:
            @service
            def add(self, a: int) -> int: return a + 1
            @service(effect="stop")
            def stop(self) -> str: return "stopped"
        container = Container(Settings.read(container="there"))
        container.register(Poor(), "robot")
        say("up")
        hear()
        resource.setrlimit(resource.RLIMIT_NOFILE, (4096, 4096))
        taken = []
        try:
            while True: taken.append(os.open("/dev/null", os.O_RDONLY))
        except OSError: pass
        say("poor")
        hear()
        """
    )
    assert program.heard() == "up"
    here = start_container("here")
    add, stop = found(here, "add"), found(here, "stop")
    assert add.start(0).result(20) == 1  # the transport's channels exist from now on
    program.tell()
    assert program.heard() == "poor"
    meet_again(here)
    assert add(1) == 2
    assert stop() == "stopped"
    assert add.start(2).result(20) == 3


def test_a_start_that_is_interrupted_leaves_nothing_on_the_shared_connection(
    here: Container, there: Container, add: Handle, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert add.start(1).result(20) == 2
    send = LocalConnection.send

    def interrupt(connection: LocalConnection, payload: bytes, key: bytes = b"") -> None:
        if key:
            connection._sock.sendall(_HEADER.pack(len(payload), len(key)))
            raise KeyboardInterrupt
        send(connection, payload, key)

    with monkeypatch.context() as half:
        half.setattr(LocalConnection, "send", interrupt)
        with pytest.raises(KeyboardInterrupt):
            add.start(2)
    assert [add.start(value).result(20) for value in range(5)] == [1, 2, 3, 4, 5]
    assert [add(value) for value in range(5)] == [1, 2, 3, 4, 5]


def test_without_another_thread_for_replies_started_calls_take_the_transport(
    here: Container, there: Container, add: Handle, monkeypatch: pytest.MonkeyPatch
) -> None:
    with without_threads("trade-local-replies", monkeypatch):
        assert add.start(1).result(20) == 2
    meet_again(here)
    local, other = taken(there)
    assert add.start(2).result(20) == 3
    assert taken(there) == (local + 1, other)


def test_a_call_that_was_sent_twice_may_have_run_though_the_second_one_was_refused(
    here: Container, there: Container, add: Handle, gate: Gate, monkeypatch: pytest.MonkeyPatch
) -> None:
    there.register(gate, "gate")
    waiting = found(here, "pass_through").start()
    assert gate.entered.wait(20)
    monkeypatch.setattr(there._parts.dispatcher._deduplicator, "find", lambda *_: None)
    monkeypatch.setattr(there._parts.dispatcher._providers, "lookup", lambda *_: None)  # as if it were gone
    break_off_all(there)
    with pytest.raises(errors.ContainerLost):  # not ServiceGone, which never ran
        waiting.result(20)
    gate.open.set()


def test_a_connection_for_stops_takes_stops_only(here: Container, there: Container, add: Handle, arm: Arm) -> None:
    arm.ran.clear()
    connection = greeted(there, here, stops=True)
    assert ends(connection, call_of(here), key_of(add, here.address.identity))
    assert arm.ran == []


def test_a_large_greeting_is_refused(there: Container, add: Handle) -> None:
    connection = LocalConnection(dialled(there))
    assert ends(connection, bytes(5000))


def test_a_serial_queue_continues_without_another_thread(
    here: Container, there: Container, add: Handle, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Press:
        def __init__(self) -> None:
            self.entered, self.open = threading.Event(), threading.Event()

        @service(serial=True)
        def press(self, value: int) -> int:
            self.entered.set()
            assert self.open.wait(30)
            return value

    machine = Press()
    there.register(machine, "press")
    press, answers = found(here, "press"), list[int]()
    threads = [threading.Thread(target=lambda value=value: answers.append(press(value))) for value in range(3)]
    threads[0].start()
    assert machine.entered.wait(20)
    for thread in threads[1:]:
        thread.start()
    wait_until(lambda: there._parts.providers.waiting() == 2, "two are queued")
    with without_threads("trade-local-call", monkeypatch):
        machine.open.set()
        for thread in threads:
            thread.join(20)
    assert sorted(answers) == [0, 1, 2]


def test_callers_of_500_threads_are_all_answered(
    here: Container, there: Container, add: Handle, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(local_path, "_MOST_FREE", 8)
    answers: list[int] = []
    busy: list[errors.Busy] = []

    def call(value: int) -> None:
        try:
            answers.append(add(value))
        except errors.Busy as refused:
            busy.append(refused)

    threads = [threading.Thread(target=call, args=(value,)) for value in range(500)]
    run_all(threads)
    assert len(answers) + len(busy) == 500
    assert len(set(answers)) == len(answers)
    wait_until(lambda: len(server(there)._threads) <= 9, "what is not needed is closed")


@pytest.mark.realtime
@pytest.mark.skipif(sys.platform != "linux", reason="fork")
def test_a_fork_takes_nothing_from_the_parent(
    start_container: Any, start_program: Any, arm: Arm, unwatched: str
) -> None:
    there = start_container("there")
    there.register(arm, "robot")
    program = start_program(
        """
        container = Container(Settings.read(container="parent"))
        add = container.find(where(name="add", local=False), wait_s=20).with_(deadline_s=20)
        add(1)
        child = os.fork()
        if child == 0:
            os._exit(0)
        os.waitpid(child, 0)
        say(str([add(value) for value in range(3)]))
        """,
        prelude=unwatched,
    )
    assert program.heard() == "[1, 2, 3]"


_CALLER = """
container = Container(Settings.read(container="caller"))
add = container.find(where(name="add", local=False), wait_s=20).with_(deadline_s=20)
add(1)
if sys.argv[1:] == ["forks"] and os.fork() == 0:
    import time
    time.sleep(60)
say(container.address)
hear()
container._parts.local_path.close()
say("closed")
hear()
"""


@pytest.fixture
def ended(there: Container, arm: Arm) -> list[str]:
    """The sessions that have ended at the container that is called."""
    there.register(arm, "robot")
    found: list[str] = []
    there.session_end.subscribe(found.append)
    return found


@pytest.mark.realtime
@needs_pidfd
def test_S12_the_end_of_a_callers_process_ends_its_session_though_its_links_last(
    there: Container, start_program: Any, unwatched: str, ended: list[str]
) -> None:
    """A forked child of it keeps them open; the transport needs a lease to see its end."""
    caller = start_program(_CALLER, "forks", prelude=unwatched)
    address = caller.heard()
    caller.process.kill()
    wait_until(lambda: ended, "its session has ended")
    sign = alive_key(Address(*address.split("/")))
    assert sign in there._parts.transport.present(ALIVE, 20), "it has no sign of life there any more"
    wait_until(lambda: not any(str(each.address) == address for each in there._parts.registry.containers()))
    assert ended == [address], "the second sign of the same end changes nothing"


@pytest.mark.realtime
@needs_pidfd
def test_S12_a_caller_that_closes_its_connections_keeps_its_session(
    there: Container, start_program: Any, ended: list[str]
) -> None:
    closes, other = start_program(_CALLER), start_program(_CALLER)
    addresses = closes.heard(), other.heard()
    closes.tell()
    assert closes.heard() == "closed"
    wait_until(lambda: len([one for one in server(there)._threads.values() if one is not None]) == 1)
    other.process.kill()
    wait_until(lambda: ended)
    assert ended == [addresses[1]]
    closes.process.kill()
    wait_until(lambda: addresses[0] in ended)


@pytest.mark.realtime
@needs_pidfd
def test_a_caller_whose_process_cannot_be_watched_ends_with_its_link(
    there: Container, start_program: Any, ended: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(process: int) -> int:
        raise OSError(errno.EMFILE, "no descriptors")

    monkeypatch.setattr(os, "pidfd_open", full)
    caller = start_program(_CALLER)
    address = caller.heard()
    caller.process.kill()
    wait_until(lambda: ended)
    assert ended == [address]


@pytest.fixture
def papers(tmp_path: Path) -> Papers:
    return Papers(tmp_path / "pki")


@pytest.fixture
def certified(start_container: Any, papers: Papers, arm: Arm) -> tuple[Container, Container]:
    there = start_container("there", tls=papers.of("robot"))
    there.register(arm, "robot")
    return start_container("here", tls=papers.of("planner")), there


def test_a_certificate_proves_who_calls(certified: tuple[Container, Container]) -> None:
    here, there = certified
    assert found(here, "who")() == "planner"
    local, other = taken(there)
    assert local >= 1
    assert found(here, "add")(1) == 2
    assert taken(there) == (local + 1, other)


@pytest.mark.parametrize("other", ["authority", "identity"])
def test_a_certificate_of_another_authority_or_identity_is_refused(
    certified: tuple[Container, Container], papers: Papers, tmp_path: Path, arm: Arm, other: str
) -> None:
    _, there = certified
    folder = Papers(tmp_path / "elsewhere").of("planner") if other == "authority" else papers.of("guest")
    assert refused(there, certificate_in(folder), "planner")
    assert arm.ran == []


def test_an_identity_without_rights_gets_no_connection_however_often_it_tries(
    start_container: Any, papers: Papers, arm: Arm, tmp_path: Path
) -> None:
    policy = tmp_path / "policy.toml"
    policy.write_text('[roles.robot]\nregister = ["*"]\ncall = ["*"]\n[identities]\nrobot = ["robot"]\n')
    there = start_container("there", tls=papers.of("robot"), policy=policy)
    there.register(arm, "robot")
    own = Address("guest", "guest", "0123456789ab")
    passport = Passport(own, certificate_in(papers.of("guest")), "")
    for stops in (True, False, True):
        connection = passport.greet(dialled(there), there.address, "guest/1", stops=stops, shared=False, limit_s=5)
        assert ends(connection)
    wait_until(lambda: not server(there)._threads, "they are closed")
    assert not server(there)._connections


def certificate_in(folder: Path) -> Callable[[], Any]:
    return lambda: Certificate.read(folder)


def refused(container: Container, certificate: Callable[[], Any], claimed: str) -> bool:
    """Whether a container takes no call of a certificate that does not fit what it claims."""
    own = Address(claimed, "forged", "0123456789ab")
    passport = Passport(own, certificate, "")
    try:
        connection = passport.greet(
            dialled(container), container.address, "forged/1", stops=False, shared=False, limit_s=5
        )
    except OSError:
        return True
    return ends(connection, b"x" * 20, f"call/{claimed}/{container.address}/robot/Arm-1".encode())


@pytest.mark.realtime
def test_a_handshake_without_answers_leaves_a_call_time_for_the_transport(
    start_container: Any, papers: Papers, arm: Arm, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(local_path, "_GREETING_S", 60.0)
    there = start_container("there", tls=papers.of("robot"))
    there.register(arm, "robot")
    with mute_socket(place(there)):
        here = start_container("here", tls=papers.of("planner"))
        assert found(here, "add").with_(deadline_s=8)(1) == 2
    assert taken(there)[0] == 0


def test_a_policy_is_enforced_on_the_local_path(start_container: Any, papers: Papers, arm: Arm, tmp_path: Path) -> None:
    policy = tmp_path / "policy.toml"
    policy.write_text(
        '[roles.robot]\nregister = ["*"]\nread = ["*"]\ncall = ["*"]\n[roles.guest]\nread = ["*"]\n'
        '[identities]\nrobot = ["robot"]\nguest = ["guest"]\n'
    )
    there = start_container("there", tls=papers.of("robot"), policy=policy)
    there.register(arm, "robot")
    here = start_container("here", tls=papers.of("guest"))
    assert found(here, "who")() == "guest"
    assert taken(there)[0] >= 1
    with pytest.raises(errors.AccessDenied):
        found(here, "add")(1)
    assert arm.ran == []
