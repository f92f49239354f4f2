"""How a container runs what it is asked: side by side, up to a cap, stops always, ``async def`` too."""

import asyncio
import gc
import itertools
import threading
import time
from typing import Any

import pytest

from tests.support.waiting import wait_until
from trade import Container, Handle, Run, current_call, service, where
from trade._services import dispatcher
from trade._threads import channel_workers
from trade.errors import Busy, Cancelled, OutcomeUnknown, RemoteError
from trade.protocol.keys import LOCAL, Address, call_key, reply_key
from trade.protocol.messages import EMPTY_ARGUMENTS, PROTOCOL, Call, encode_message
from trade.testing import VirtualTime, memory_system
from trade.transport.base import Channel, Message, Publisher
from trade.transport.memory import MemoryTransport

pytestmark = pytest.mark.virtual_time


def found(here: Container, name: str) -> Handle:
    return here.find(where(name=name, group="robot"), wait_s=20)


class Crowd:
    """As many as come stay inside until the gate opens."""

    def __init__(self) -> None:
        self.inside = threading.Semaphore(0)
        self.open = threading.Event()
        self.stopped = 0

    @service
    def enter(self) -> None:
        self.inside.release()
        self.open.wait(60)

    @service(effect="stop")
    def stop(self) -> int:
        self.stopped += 1
        return self.stopped

    def wait_for(self, count: int) -> None:
        for _ in range(count):
            assert self.inside.acquire(timeout=20)


def entered(enter: Handle, crowd: Crowd) -> Run:
    """A call that runs. At the cap a call is refused while the thread of the one before it is busy."""
    for _ in range(100):
        run = enter.start()
        wait_until(lambda run=run: run.done() or crowd.inside.acquire(blocking=False))
        if not run.done():
            return run
        assert isinstance(run.exception(), Busy)
    raise AssertionError("no call was let in")


@pytest.fixture
def crowd() -> Any:
    crowd = Crowd()
    yield crowd
    crowd.open.set()


def test_services_run_side_by_side(here: Container, there: Container, crowd: Crowd) -> None:
    there.register(crowd, "robot")
    enter = found(here, "enter")
    runs = [enter.start() for _ in range(10)]
    crowd.wait_for(10)
    crowd.open.set()
    assert [run.result(20) for run in runs] == [None] * 10


@pytest.mark.usefixtures("no_local_path")
def test_at_the_cap_a_call_is_refused_and_stops_still_get_through(
    here: Container, there: Container, crowd: Crowd, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(channel_workers, "MOST_THREADS", 8)
    there.register(crowd, "robot")
    enter, stop = found(here, "enter"), found(here, "stop")
    assert stop() == 1
    runs = [enter.start() for _ in range(7)]  # the eighth thread drains the channel
    crowd.wait_for(7)
    with pytest.raises(Busy, match=r"robot.enter did not run: container there has no free handler thread. Try again"):
        enter()
    with pytest.raises(BlockingIOError):
        enter.start().result(20)
    assert [stop() for _ in range(20)] == list(range(2, 22))
    crowd.open.set()
    for run in runs:
        run.result(20)
    enter()
    assert there.healthy()


def test_a_container_at_its_cap_still_drains(
    here: Container, there: Container, crowd: Crowd, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(channel_workers, "MOST_THREADS", 2)
    there.register(crowd, "robot")
    enter = found(here, "enter")
    run = entered(enter, crowd)
    refused = [enter.start() for _ in range(200)]
    assert all(isinstance(one.exception(20), Busy) for one in refused)
    assert there.healthy()
    crowd.open.set()
    run.result(20)


@pytest.mark.usefixtures("no_local_path")
def test_when_the_process_can_have_no_more_threads_a_call_is_refused(
    here: Container, there: Container, crowd: Crowd, monkeypatch: pytest.MonkeyPatch, eventually: Any
) -> None:
    there.register(crowd, "robot")
    enter = found(here, "enter")
    start = threading.Thread.start

    def refuse(thread: threading.Thread) -> None:
        if thread.name.startswith("trade-call"):
            raise RuntimeError("can't start new thread")
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", refuse)
    runs = [enter.start() for _ in range(10)]
    assert eventually(lambda: any(run.done() for run in runs))
    assert isinstance(next(run for run in runs if run.done()).exception(), Busy)
    assert there.healthy()
    monkeypatch.undo()
    crowd.open.set()
    assert {type(run.exception(20)) for run in runs} <= {Busy, type(None)}
    enter()


def test_async_services_run_concurrently_on_one_loop(offer: Any) -> None:
    class Meeting:
        def __init__(self) -> None:
            self.both = asyncio.Event()
            self.loops: set[int] = set()

        @service
        async def wait(self) -> str:
            self.loops.add(id(asyncio.get_running_loop()))
            await self.both.wait()
            return "met"

        @service
        async def come(self) -> str:
            self.loops.add(id(asyncio.get_running_loop()))
            self.both.set()
            return "came"

    meeting = Meeting()
    services = offer(meeting)
    waiting = services("wait").start()
    assert services("come")() == "came"
    assert waiting.result(20) == "met"
    assert len(meeting.loops) == 1


def test_an_async_service_knows_its_call_and_makes_others(offer: Any, here: Container) -> None:
    class Inner:
        @service
        async def double(self, value: int) -> int:
            return 2 * value

    class Outer:
        @service
        async def quadruple(self, inner: Handle, value: int) -> int:
            call = current_call()
            assert call is not None
            assert call.service == "robot.quadruple"
            return 2 * await inner.acall(value)

    (inner,) = here.register(Inner(), "inner")
    assert offer(Outer())("quadruple")(inner, 3) == 12


def test_an_async_service_is_cancelled_at_its_deadline(offer: Any) -> None:
    class Slow:
        def __init__(self) -> None:
            self.cancelled = threading.Event()

        @service
        async def wait(self) -> None:
            try:
                await asyncio.Event().wait()
            except asyncio.CancelledError:
                self.cancelled.set()
                raise

    slow = Slow()
    with pytest.raises(OutcomeUnknown, match=r"no answer from robot.wait within"):
        offer(slow)("wait").with_(deadline_s=1)()
    assert slow.cancelled.wait(20)


@pytest.mark.parametrize("error", [SystemExit(1), KeyboardInterrupt()], ids=["exit", "interrupt"])
def test_an_async_service_that_raises_exit_kills_no_other(here: Container, there: Container, error: Any) -> None:
    class Loop:
        @service
        async def leave(self) -> None:
            raise error

        @service
        async def stay(self) -> str:
            return "here"

    there.register(Loop(), "robot")
    with pytest.raises(RemoteError, match=rf"builtins:{type(error).__name__}"):
        found(here, "leave")()
    assert found(here, "stay")() == "here"


def test_an_async_service_that_cancels_itself_is_an_error_of_its_own(offer: Any) -> None:
    class Quitter:
        @service
        async def quit(self) -> None:
            raise asyncio.CancelledError

    with pytest.raises(Cancelled, match=r"the call of robot.quit was cancelled"):
        offer(Quitter())("quit")()


def test_closing_a_container_cancels_its_async_services(here: Container, there: Container) -> None:
    class Slow:
        def __init__(self) -> None:
            self.entered, self.ended = threading.Event(), threading.Event()

        @service
        async def wait(self) -> None:
            self.entered.set()
            try:
                await asyncio.Event().wait()
            finally:
                self.ended.set()

    slow = Slow()
    there.register(slow, "robot")
    run = found(here, "wait").start()
    assert slow.entered.wait(20)
    there.close()
    assert slow.ended.wait(20)
    assert isinstance(run.exception(20), ConnectionError)


def test_a_service_may_close_its_own_container(here: Container, there: Container, eventually: Any) -> None:
    class Ender:
        @service
        def end(self) -> None:
            there.close()

    there.register(Ender(), "robot")
    with pytest.raises(ConnectionError):
        found(here, "end")()
    assert eventually(lambda: not there.healthy())


def test_a_service_may_deregister_itself(here: Container, there: Container) -> None:
    class Once:
        @service
        def go(self) -> str:
            there.deregister(self)
            return "once"

    there.register(Once(), "robot")
    assert found(here, "go")() == "once"


def test_a_service_may_register_others_and_look_up(here: Container, there: Container) -> None:
    class Factory:
        @service
        def make(self) -> Handle:
            return there.register(Crowd(), "made")[1]

    there.register(Factory(), "robot")
    assert found(here, "make")()() == 1


@pytest.mark.usefixtures("no_local_path")
def test_only_so_many_reply_keys_are_kept_and_evicted_ones_work_again(
    here: Container, there: Container, monkeypatch: pytest.MonkeyPatch, crowd: Crowd
) -> None:
    monkeypatch.setattr(dispatcher, "_MOST_REPLY_KEYS", 2)
    there.register(crowd, "robot")
    enter = found(here, "enter")
    threads = [threading.Thread(target=enter) for _ in range(6)]  # each borrows a reply key of its own
    for thread in threads:
        thread.start()
    crowd.wait_for(6)
    crowd.open.set()
    for thread in threads:
        thread.join(20)
        assert not thread.is_alive()
    assert len(there._parts.dispatcher._repliers) <= 2


def test_a_reply_key_undeclared_while_answering_is_declared_again(here: Container, there: Container) -> None:
    class Evicting:
        @service
        def answer(self) -> str:
            for replier in there._parts.dispatcher._repliers.values():
                replier.close()
            there._parts.dispatcher._repliers.clear()
            return "still here"

    there.register(Evicting(), "robot")
    answer = found(here, "answer")
    assert answer() == "still here"
    assert reply_key("a", "b", "c", "0") == "reply/a/b/c/0"


class Endless:
    """Its service ends when the container does."""

    def __init__(self) -> None:
        self.entered = threading.Event()

    @service
    async def wait(self) -> None:
        self.entered.set()
        await asyncio.Event().wait()


def test_no_thread_goes_back_into_a_transport_that_is_being_left(monkeypatch: pytest.MonkeyPatch) -> None:
    """An interpreter that ends while a thread is on its way out of the transport is aborted."""
    read_again: list[str] = []

    class Watched(Channel):
        def __init__(self, inner: Channel) -> None:
            self.inner, self.closed = inner, False

        def receive(self) -> Message:
            if self.closed:
                read_again.append(threading.current_thread().name)
            return self.inner.receive()

        def close(self) -> None:
            self.closed = True
            self.inner.close()

    subscribe = MemoryTransport.subscribe
    monkeypatch.setattr(
        MemoryTransport, "subscribe", lambda self, pattern, **how: Watched(subscribe(self, pattern, **how))
    )
    with memory_system() as system:
        there, endless = system.container("there"), Endless()
        there.register(endless, "robot")
        run = system.container("here").find(where(name="wait")).start()
        assert endless.entered.wait(20)
        callers = [thread for thread in threading.enumerate() if thread.name.startswith("trade-call")]
        there.close()
        assert read_again == []
        assert sum(thread.is_alive() for thread in callers) == 1  # the caller's own, which waits for calls
        with pytest.raises(ConnectionError):
            run.result(20)


@pytest.mark.usefixtures("no_local_path")
def test_no_reply_key_is_kept_of_a_caller_that_is_gone(here: Container, there: Container, crowd: Crowd) -> None:
    there.register(crowd, "robot")
    crowd.open.set()
    repliers = there._parts.dispatcher._repliers
    found(here, "enter")()
    assert any("/here/" in key for key in repliers)
    here.close()
    wait_until(lambda: not any("/here/" in key for key in list(repliers)))


def test_only_a_call_whose_service_was_quick_last_keeps_the_next_message_waiting(
    here: Container, there: Container
) -> None:
    if VirtualTime.current() is None:
        pytest.skip("it judges by moments: on the real clock, threads also wait for a processor")
    order = list[str]()

    class Press:
        takes_s = 0.0

        @service
        def press(self) -> None:
            order.append("pressed")
            threading.Event().wait(self.takes_s)

    machine = Press()
    there.register(machine, "robot")
    key = found(here, "press").key
    path = call_key("tester", key.address, key.domain, key.provider, stop=False)
    for number, machine.takes_s in enumerate([0.0, 0.0, 0.01, 0.0, 0.0]):
        expires_ns, session, reply = time.monotonic_ns() + 10**10, "tester/there/1", "there/1"
        call = Call(PROTOCOL, number + 1, "press", reply, session, expires_ns, (), EMPTY_ARGUMENTS)
        message = Message(path, encode_message(call))
        there._parts.dispatcher.serve(message, pass_on=lambda: order.append("next is read"))
    read = "next is read"
    assert order == [read, "pressed", "pressed", "pressed", read, "pressed", "pressed"]


class _Hung(Publisher):
    """Counts how often it was closed."""

    def __init__(self) -> None:
        self.closed = 0

    def put(self, payload: bytes) -> None: ...

    def close(self) -> None:
        self.closed += 1


def test_S05_a_caller_that_ends_is_hung_up_although_another_comes_just_then(here: Container) -> None:
    """The garbage collector runs finalizers in the middle of a line, and other threads run meanwhile."""
    calls, gone, other = here._parts.dispatcher, _Hung(), _Hung()
    ended = Address("tester", "gone", "e1")
    calls.answer_on("tester", f"gone/e1{LOCAL}0", gone)
    for number in range(5000):  # so many that the interpreter has no free pairs left, and collects garbage for more
        calls.answer_on("tester", f"other/e2{LOCAL}{number}", other)
    numbers = itertools.count(5000)

    def another_comes(phase: str, _: object) -> None:
        if phase == "start":
            calls.answer_on("tester", f"other/e2{LOCAL}{next(numbers)}", other)

    usual, enabled = gc.get_threshold(), gc.isenabled()
    gc.callbacks.append(another_comes)
    gc.set_threshold(1)
    gc.enable()
    try:
        calls.hang_up(ended)
    finally:
        if not enabled:  # as on virtual time
            gc.disable()
        gc.set_threshold(*usual)
        gc.callbacks.remove(another_comes)
    assert (gone.closed, other.closed) == (1, 0)
