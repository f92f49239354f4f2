"""Deadlines: late is never, an overrun is unknown, and a stop is never late."""

import asyncio
import contextlib
import gc
import itertools
import threading
from pathlib import Path
from typing import Any

import pytest

from trade import Container, Handle, current_call, service, where
from trade._calls.peer import Peer, Pending
from trade.errors import DeadlineExceeded, OutcomeUnknown
from trade.protocol.keys import call_key, reply_key
from trade.protocol.messages import EMPTY_ARGUMENTS, PROTOCOL, Call, Reply, Status, decode_reply, encode_message

COUNTING = """
from pathlib import Path
class Motor:
    @service
    def move(self) -> None:
        with Path(sys.argv[1]).open("a") as log: log.write("moved\\n")
    @service(effect="stop")
    def stop(self) -> None:
        with Path(sys.argv[1]).open("a") as log: log.write("stopped\\n")
with Container(Settings.read(container="driver")) as driver:
    driver.register(Motor(), "robot")
    say("ready")
    hear()
"""


class Motor:
    def __init__(self) -> None:
        self.moves = self.stops = 0

    @service
    def move(self) -> None:
        self.moves += 1

    @service(effect="stop")
    def stop(self) -> float | None:
        self.stops += 1
        call = current_call()
        assert call is not None
        return call.remaining_s

    @service
    def left(self) -> float | None:
        call = current_call()
        return None if call is None else call.remaining_s


def found(here: Container, name: str) -> Handle:
    return here.find(where(name=name, group="robot"), wait_s=20)


@pytest.mark.realtime
@pytest.mark.parametrize("how", ["call", "start", "acall"])
def test_an_overrun_is_an_unknown_outcome(here: Container, there: Container, gate: Any, how: str) -> None:
    there.register(gate, "robot")
    inside = found(here, "pass_through").with_(deadline_s=0.5)
    here.find(where(name="clock", container="there"))()  # else the clock would be asked for first
    ways = {"call": inside, "start": lambda: inside.start().result(20), "acall": lambda: asyncio.run(inside.acall())}
    with pytest.raises(OutcomeUnknown, match=r"no answer from robot.pass_through within 0.5 s. Whether it ran is"):
        ways[how]()


def test_an_overrun_is_a_timeout_error(here: Container, there: Container, gate: Any) -> None:
    there.register(gate, "robot")
    with pytest.raises(TimeoutError):
        found(here, "pass_through").with_(deadline_s=0.05)()


@pytest.mark.realtime
def test_an_answer_after_the_deadline_disturbs_no_later_call(here: Container, there: Container, gate: Any) -> None:
    there.register(gate, "robot")
    here.find(where(name="clock", container="there"), wait_s=20)()
    with pytest.raises(OutcomeUnknown):
        found(here, "pass_through").with_(deadline_s=0.5)()
    gate.open.set()
    assert [found(here, "pass_through")() for _ in range(5)] == ["through"] * 5


def test_short_deadlines_end_on_time_beside_long_ones(here: Container, there: Container, gate: Any) -> None:
    there.register(gate, "robot")
    inside = found(here, "pass_through")
    long = inside.with_(deadline_s=60).start()
    assert gate.entered.wait(20)
    short = [inside.with_(deadline_s=0.05).start() for _ in range(5)]
    for run in short:
        assert isinstance(run.exception(20), TimeoutError)
    assert not long.done()
    gate.open.set()
    assert long.result(20) == "through"


class Outer:
    """Makes calls of its own, in time or when its deadline has passed."""

    outcome: Any = None

    @service
    def relay(self, inner: Handle, own_deadline_s: float) -> Any:
        return inner.with_(deadline_s=own_deadline_s)()

    @service
    def too_late(self, inner: Handle) -> None:
        call = current_call()
        assert call is not None
        while call.remaining_s:
            threading.Event().wait(0.01)
        try:
            self.outcome = inner()
        except Exception as error:  # noqa: BLE001 - the test looks at it
            self.outcome = error
        finally:
            self.done.set()

    def __init__(self) -> None:
        self.done = threading.Event()


@pytest.fixture(params=["local", "remote"])
def inner(request: pytest.FixtureRequest, here: Container, there: Container) -> tuple[Motor, dict[str, Handle]]:
    """A motor beside the service that calls it, or in another container."""
    motor = Motor()
    (there if request.param == "local" else here).register(motor, "robot")
    return motor, {name: found(here, name) for name in ("move", "stop", "left")}


def test_a_nested_call_has_what_is_left_of_the_outer_one(here: Container, there: Container, inner: Any) -> None:
    there.register(Outer(), "robot")
    relay = found(here, "relay").with_(deadline_s=100)
    assert 50 < relay(inner[1]["left"], 1000.0) <= 100
    assert relay(inner[1]["left"], 20.0) <= 20


def test_a_nested_call_after_the_deadline_never_runs(here: Container, there: Container, inner: Any) -> None:
    motor, services = inner
    outer = Outer()
    there.register(outer, "robot")
    with contextlib.suppress(OutcomeUnknown):  # it may still answer in time that it was too late
        found(here, "too_late").with_(deadline_s=0.5)(services["move"])
    assert outer.done.wait(20)
    assert isinstance(outer.outcome, DeadlineExceeded)
    assert motor.moves == 0


def test_a_nested_stop_after_the_deadline_is_sent_and_answered(here: Container, there: Container, inner: Any) -> None:
    motor, services = inner
    outer = Outer()
    there.register(outer, "robot")
    with contextlib.suppress(OutcomeUnknown):
        found(here, "too_late").with_(deadline_s=0.5)(services["stop"])
    assert outer.done.wait(20)
    assert (outer.outcome, motor.stops) == (None, 1)


def test_a_stop_knows_no_deadline(offer: Any) -> None:
    assert offer(Motor())("stop").with_(deadline_s=5)() is None


@pytest.mark.realtime
def test_S01_a_call_that_arrives_late_never_runs(start_program: Any, here: Container, tmp_path: Path) -> None:
    log = tmp_path / "log"
    program = start_program(COUNTING, str(log))
    program.heard()
    move = found(here, "move")
    move()
    program.freeze()
    late = [move.with_(deadline_s=0.3).start() for _ in range(10)]
    for run in late:
        assert isinstance(run.exception(20), OutcomeUnknown)
    program.thaw()
    move.with_(deadline_s=60)()
    program.tell()
    assert program.ends() == 0
    assert log.read_text().splitlines() == ["moved", "moved"]


@pytest.mark.realtime
def test_S01_a_first_call_to_a_frozen_container_never_runs(start_program: Any, here: Container, tmp_path: Path) -> None:
    log = tmp_path / "log"
    program = start_program(COUNTING, str(log))
    program.heard()
    move = found(here, "move")
    program.freeze()
    with pytest.raises(DeadlineExceeded):  # not even sent: the clock was asked for first
        move.with_(deadline_s=0.3)()
    assert isinstance(move.with_(deadline_s=0.3).start().exception(20), DeadlineExceeded)
    program.thaw()
    move.with_(deadline_s=60)()
    program.tell()
    assert program.ends() == 0
    assert log.read_text().splitlines() == ["moved"]


@pytest.mark.realtime
def test_a_stop_sent_to_a_frozen_container_runs_when_it_wakes(
    start_program: Any, here: Container, tmp_path: Path, eventually: Any
) -> None:
    log = tmp_path / "log"
    program = start_program(COUNTING, str(log))
    program.heard()
    stop = found(here, "stop")
    program.freeze()
    with pytest.raises(OutcomeUnknown):
        stop.with_(deadline_s=0.2)()
    program.thaw()
    assert eventually(log.exists)
    assert log.read_text() == "stopped\n"


ARRIVING = {
    "actuating, expiry unknown": ("move", None, Status.EXPIRED, (0, 0)),
    "actuating, expired": ("move", 1, Status.EXPIRED, (0, 0)),
    "actuating, in time": ("move", 2**62, Status.OK, (1, 0)),
    "reading, expiry unknown": ("clock", None, Status.OK, (0, 0)),
    "reading, expired": ("clock", 1, Status.EXPIRED, (0, 0)),
    "stop, expiry unknown": ("stop", None, Status.OK, (0, 1)),
    "stop, expired": ("stop", 1, Status.OK, (0, 1)),
}


@pytest.mark.parametrize(("name", "expires_ns", "status", "ran"), ARRIVING.values(), ids=list(ARRIVING))
def test_what_arrives_runs_only_if_it_is_known_to_be_in_time(
    here: Container, open_raw: Any, name: str, expires_ns: int | None, status: int, ran: tuple[int, int]
) -> None:
    motor = Motor()
    (handle, *_) = here.register(motor, "robot")
    key = here.find(where(name="clock")).key if name == "clock" else handle.key
    raw = open_raw(here)
    replies = raw.subscribe(reply_key(here.address.identity, "tester", "raw", "0"))
    call = Call(PROTOCOL, 7, name, "raw/0", "tester/raw/0", expires_ns, (), EMPTY_ARGUMENTS)
    raw.publish(call_key("tester", key.address, key.domain, key.provider, stop=name == "stop")).put(
        encode_message(call)
    )
    reply = decode_reply(replies.receive().payload or b"")
    assert (reply.id, reply.status) == (7, status)
    assert (motor.moves, motor.stops) == ran


def test_calls_end_at_their_deadlines_although_others_begin_while_they_are_looked_through(
    here: Container, there: Container
) -> None:
    """Making things may collect garbage, and whatever that lets go of may let another thread run."""
    caller = here._parts.caller
    peer = Peer(there.address)
    ended: list[int] = []

    def note(reply: Reply) -> None:
        ended.append(reply.id)

    def begin(number: int) -> None:
        caller._pending[number] = Pending(peer, 0, note, None, (None, b""))  # type: ignore[arg-type]

    others = itertools.count(10_000)

    def interrupt(phase: str, _: object) -> None:
        if phase == "start":
            begin(next(others))

    for number in range(5000):
        begin(number)
    before = gc.get_threshold()
    gc.callbacks.append(interrupt)
    gc.set_threshold(1)
    try:
        caller._end_overdue()
    finally:
        gc.set_threshold(*before)
        gc.callbacks.remove(interrupt)
        caller._end_overdue()
    assert {*range(5000)} <= {*ended}
