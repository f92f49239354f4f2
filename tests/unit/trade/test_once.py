"""S02: a call that comes twice runs once, is answered as often as it came, and its answer is kept in bounds."""

import gc
import threading
import time
from typing import Any

import msgspec
import pytest
from msgspec import structs

from trade import Container, Handle, service, where
from trade._context import active_calls
from trade._context.active_calls import ActiveCall, CallDeduplicator
from trade.protocol.keys import Address, call_key, reply_key
from trade.protocol.messages import EMPTY, EMPTY_ARGUMENTS, PROTOCOL, Call, Reply, Status, decode_reply, encode_message

SECOND_NS = 10**9
LATER = 2**62


def call(call_id: int = 7, name: str = "move", expires_ns: int | None = LATER, reply: str = "raw/0") -> Call:
    return Call(PROTOCOL, call_id, name, reply, "tester/raw/0", expires_ns, (), EMPTY_ARGUMENTS)


class Motor:
    def __init__(self) -> None:
        self.moves = self.looks = 0
        self.entered, self.open = threading.Event(), threading.Event()

    @service
    def move(self) -> int:
        self.moves += 1
        return self.moves

    @service
    def move_slowly(self) -> int:
        self.moves += 1
        self.entered.set()
        self.open.wait(20)
        return self.moves

    @service(serial=True)
    def move_in_turn(self) -> int:
        self.moves += 1
        return self.moves

    @service(effect="read")
    def look(self) -> int:
        self.looks += 1
        return self.looks


class Line:
    """Bare calls to one provider, and their answers."""

    def __init__(self, raw: Any, here: Container, key: Any, caller: str = "tester") -> None:
        self._caller = caller
        self._replies = raw.subscribe(reply_key(here.address.identity, caller, "raw", "*"))
        self._publisher = raw.publish(call_key(caller, key.address, key.domain, key.provider, stop=False))

    def put(self, *calls: Call) -> None:
        for one in calls:
            self._publisher.put(encode_message(structs.replace(one, session=f"{self._caller}/raw/0")))

    def answer(self) -> Reply:
        return decode_reply(self._replies.receive().payload or b"")


@pytest.fixture
def motor() -> Any:
    motor = Motor()
    yield motor
    motor.open.set()


@pytest.fixture
def key(here: Container, motor: Motor) -> Any:
    return here.register(motor, "robot")[0].key


@pytest.fixture
def line(here: Container, open_raw: Any, key: Any) -> Line:
    return Line(open_raw(here), here, key)


@pytest.mark.parametrize("name", ["move", "move_in_turn"])
def test_S02_a_call_that_comes_twice_runs_once_and_is_answered_twice(line: Line, motor: Motor, name: str) -> None:
    line.put(call(name=name), call(name=name))
    assert [line.answer().body for _ in range(2)] == [msgspec.Raw(msgspec.msgpack.encode(1))] * 2
    assert motor.moves == 1


def test_S02_a_call_that_comes_again_while_it_runs_waits_for_that_answer(line: Line, motor: Motor) -> None:
    line.put(call(name="move_slowly"))
    assert motor.entered.wait(20)
    line.put(call(name="move_slowly", reply="raw/1"), call(8))
    assert line.answer().id == 8
    motor.open.set()
    assert [line.answer().id for _ in range(2)] == [7, 7]
    assert motor.moves == 2


def test_S02_a_call_that_comes_again_after_its_provider_left_gets_its_answer(
    here: Container, line: Line, motor: Motor
) -> None:
    line.put(call())
    assert line.answer().status == Status.OK
    here.deregister(motor)
    line.put(call(), call(8))
    assert {(one.id, one.status) for one in (line.answer(), line.answer())} == {(7, Status.OK), (8, Status.GONE)}


def test_S02_the_same_number_from_another_client_is_another_call(
    here: Container, open_raw: Any, key: Any, line: Line, motor: Motor
) -> None:
    other = Line(open_raw(here), here, key, "other")
    line.put(call())
    assert line.answer().status == Status.OK
    other.put(call())
    assert other.answer().status == Status.OK
    assert motor.moves == 2


def test_what_expired_is_said_to_have_expired_however_often_it_comes(line: Line, motor: Motor) -> None:
    line.put(call(expires_ns=1), call(expires_ns=1))
    assert [line.answer().status for _ in range(2)] == [Status.EXPIRED] * 2
    assert motor.moves == 0


def test_answers_of_what_reads_are_not_kept(here: Container, line: Line) -> None:
    line.put(call(name="look"))
    line.answer()
    once = here._parts.dispatcher._deduplicator
    assert (once._running, once._kept) == ({}, {})


def begun(once: CallDeduplicator, one: Call) -> ActiveCall:
    ongoing = ActiveCall("me", one, None)
    assert once.begin(one, ongoing) is ongoing
    return ongoing


def end(once: CallDeduplicator, one: Call, body: bytes = b"") -> None:
    answer = (Status.OK, msgspec.Raw(msgspec.msgpack.encode(body)) if body else EMPTY)
    once.end(begun(once, one), one, answer, keep=True)


def test_answers_are_dropped_some_seconds_after_their_deadline(monkeypatch: pytest.MonkeyPatch) -> None:
    once = CallDeduplicator()
    now = time.monotonic_ns()
    for i in range(600):
        end(once, call(i, expires_ns=now - 6 * SECOND_NS))
    for i in range(600, 1200):
        end(once, call(i, expires_ns=now + 60 * SECOND_NS))
    assert once.find("me", call(0)) is None
    assert all(once.find("me", call(i)) for i in range(600, 1200))


def test_no_call_forgets_a_whole_burst_of_earlier_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """All calls wait while one forgets: for 65,536 of them, 0.2 to 0.3 s."""
    once = CallDeduplicator()
    for i in range(1000):
        end(once, call(i))
    monkeypatch.setattr(active_calls, "MOST_CALLS", 10)
    end(once, call(1000))
    assert len(once._kept) > 990
    for i in range(1001, 1200):
        end(once, call(i))
    assert len(once._kept) == 10


def test_what_is_kept_of_a_call_never_delays_the_garbage_collector() -> None:
    """It stops all threads while it visits every object, and tens of thousands of answers are kept."""
    once = CallDeduplicator()
    for i in range(100):
        end(once, call(i))
    assert not any(map(gc.is_tracked, once._kept.values()))


def test_a_call_under_way_is_never_forgotten_and_too_old_ones_never_run_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(active_calls, "MOST_CALLS", 1024)
    once = CallDeduplicator()
    running = begun(once, call(0))
    for i in range(1, 3000):
        end(once, call(i))
    assert len(once._kept) <= 1024
    assert once.find("me", call(0)) is running
    assert running.answer is None
    forgotten = ActiveCall("me", call(1), None)
    once.begin(call(1), forgotten)
    assert forgotten.answer is not None  # known only by its number: whether it ran is not said
    assert b"OutcomeUnknown" in bytes(forgotten.answer[1])


def test_large_answers_are_dropped_first_but_not_the_record_that_they_were_given(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(active_calls, "MOST_BYTES", 10_000)
    once = CallDeduplicator()
    for i in range(20):
        end(once, call(i, expires_ns=LATER), b"x" * 1000)
    assert once._bytes <= 10_000
    first, last = once.find("me", call(0)), once.find("me", call(19))
    assert first is not None
    assert first.answer is not None
    assert b"OutcomeUnknown" in bytes(first.answer[1])
    assert last is not None
    assert last.answer is not None
    assert last.answer[0] == Status.OK


def test_the_answer_that_says_that_one_was_dropped_is_made_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A large answer drops a thousand small ones, and the calls of others wait meanwhile."""
    monkeypatch.setattr(active_calls, "MOST_BYTES", 10_000)
    once = CallDeduplicator()
    for i in range(1000):
        end(once, call(i, "small", expires_ns=LATER), b"x")
    end(once, call(1000, "large", expires_ns=LATER), b"x" * 9_990)
    dropped = [one.answer for i in range(900) if (one := once.find("me", call(i))) is not None]
    assert len(dropped) == 900
    assert len(set(map(id, dropped))) == 1
    assert dropped[0] is not None
    assert b"small" in bytes(dropped[0][1])  # the service whose answer it was


@pytest.mark.usefixtures("no_local_path")
@pytest.mark.parametrize("how", ["call", "start"])
def test_S02_what_waits_is_sent_again_when_the_link_to_the_same_epoch_is_back(
    here: Container, there: Container, motor: Motor, how: str
) -> None:
    there.register(motor, "robot")
    move: Handle = here.find(where(name="move_slowly", group="robot"), wait_s=20)
    result: list[int] = []
    thread = threading.Thread(target=lambda: result.append(move() if how == "call" else move.start().result(20)))
    thread.start()
    assert motor.entered.wait(20)
    sent: list[Call] = []
    once = there._parts.dispatcher._deduplicator
    attach = once.attach
    again = threading.Event()

    def note(ongoing: ActiveCall, call: Call) -> Any:
        sent.append(call)
        answer = attach(ongoing, call)
        again.set()
        return answer

    once.attach = note  # type: ignore[method-assign]
    here._parts.caller.lost(there.address, back=True)
    assert again.wait(20)
    motor.open.set()
    thread.join(20)
    assert result == [1]
    assert motor.moves == 1
    assert len(sent) == 1


def test_a_container_that_returns_is_sent_nothing_if_nothing_waits(here: Container, there: Container) -> None:
    here._parts.caller.lost(there.address, back=True)
    assert here._parts.caller._pending == {}
    assert here._parts.caller.peer(Address("a", "b", "c")).clock_known is False
