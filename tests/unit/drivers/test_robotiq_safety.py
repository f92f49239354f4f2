"""The motion rules on a gripper, by their numbers; the judge is what the simulated gripper received and did."""

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Outcome, call, sleep_past, written_now
from tests.unit.drivers.gate import Gate
from tests.unit.drivers.gripper_rig import HandRig, hand, rig
from trade import Container, Handle, errors, where
from trade_drivers import Gripper
from trade_hil_sim import Heal, Mute, Put, instructions

pytestmark = pytest.mark.virtual_time

__all__ = ["hand", "rig"]

SLOW_M_S = 0.02


@pytest.mark.parametrize("command", ["activate", "clear_fault"])
def test_S01_a_command_of_a_gripper_at_rest_that_expires_while_the_bus_is_held_up_is_never_written(
    hand: HandRig, gate: Gate, command: str
) -> None:
    gripper = hand.gripper(healthy=gate)
    gate.hold_up()
    mark = written_now()
    late = Outcome(getattr(gripper, command), 0.05)
    with call(0.05) as expires_ns:
        sleep_past(expires_ns)
    gate.release()
    assert isinstance(late.wait().error, errors.DeadlineExceeded)
    assert not hand.writes(mark)


def test_S01_a_reset_that_expires_ends_no_motion_of_another_call(hand: HandRig, gate: Gate) -> None:
    gripper = hand.active(healthy=gate)
    moving = Outcome(lambda: gripper.close(SLOW_M_S))
    hand.under_way()
    gate.hold_up()
    mark = written_now()
    late = Outcome(gripper.clear_fault, 0.05)
    with call(0.05) as expires_ns:
        sleep_past(expires_ns)
    gate.release()
    assert isinstance(late.wait().error, errors.DeadlineExceeded)
    assert moving.wait().error is None
    assert not hand.writes(mark)


def test_S02_a_command_that_expires_after_it_was_sent_has_an_unknown_outcome(hand: HandRig) -> None:
    gripper = hand.active()
    hand.sim.do(Mute(instruction="read_write"))
    mark = written_now()
    error = Outcome(gripper.clear_fault, deadline_s=0.1).wait().error
    assert hand.writes(mark)
    assert isinstance(error, errors.OutcomeUnknown)


def test_S01_a_command_is_not_repeated_after_its_deadline_and_its_fingers_are_stopped(hand: HandRig) -> None:
    gripper = hand.active()
    hand.sim.do(Mute(instruction="read_write"))
    mark = written_now()
    late = Outcome(lambda: gripper.close(SLOW_M_S), deadline_s=0.1).wait()
    assert isinstance(late.error, errors.OutcomeUnknown | errors.DeviceSilent | errors.MotionStopped)
    moves = hand.moves(mark)
    assert moves
    assert max(entry.t for entry in moves) - min(entry.t for entry in moves) < 0.1
    hand.sim.do(Heal())
    wait_until(lambda: not hand.truth.moving, "it is at rest")
    assert hand.truth.width_m > 0.03
    assert len(hand.moves(mark)) == len(moves)


def test_S06_that_a_2F85_has_no_watchdog_is_in_the_documentation() -> None:
    page = Path(__file__).parents[3].joinpath("docs", "drivers.md").read_text(encoding="utf-8")
    assert "no watchdog" in page[page.index("## Robotiq") :]


def test_S07_a_stop_is_the_first_thing_on_a_bus_that_was_held_up(hand: HandRig, gate: Gate) -> None:
    gripper = hand.active(healthy=gate)
    moving = Outcome(lambda: gripper.close(SLOW_M_S))
    hand.under_way()
    gate.hold_up()
    mark = written_now()
    stop = Outcome(gripper.stop)
    wait_until(lambda: gripper._exchange._stops, "the stop is queued")  # type: ignore[attr-defined]
    gate.release()
    assert stop.wait().error is None
    assert isinstance(moving.wait().error, errors.MotionStopped)
    first = instructions(hand.log, since=mark)[0]
    assert (first.name, first.moves) == ("read_write", False)
    assert not hand.truth.moving


def test_S08_a_stop_ends_activation_and_leaves_it_not_activated(hand: HandRig) -> None:
    gripper = hand.gripper()
    activating = Outcome(gripper.activate)
    wait_until(lambda: hand.truth.moving, "its fingers move")
    mark = written_now()
    gripper.stop()
    assert isinstance(activating.wait().error, errors.MotionStopped)
    assert not hand.truth.moving
    assert not gripper.state().activated
    assert not hand.moves(mark)


def test_S08_a_stop_that_is_not_answered_is_written_again_until_it_is_heard(hand: HandRig) -> None:
    gripper = hand.active()
    moving = Outcome(lambda: gripper.close(SLOW_M_S))
    hand.under_way()
    hand.sim.do(Mute(instruction="read_write", count=1))
    gripper.stop()
    assert isinstance(moving.wait().error, errors.MotionStopped)
    assert not hand.truth.moving
    assert hand.truth.width_m > 0.03


def test_S08_a_stop_of_a_silent_gripper_is_sent_without_a_reading_and_cannot_activate_it(hand: HandRig) -> None:
    gripper = hand.active()
    moving = Outcome(lambda: gripper.close(SLOW_M_S))
    hand.under_way()
    hand.sim.do(Mute())
    assert isinstance(moving.wait().error, errors.DeviceSilent)
    wait_until(lambda: not hand.truth.moving, "it is at rest")
    mark = written_now()
    with pytest.raises(errors.DeviceSilent):
        gripper.stop()
    assert {entry.hex for entry in hand.writes(mark)} == {"00" * 6}
    assert hand.truth.width_m > 0.03


HAND_SERVICES = where(group="rosie.left.hand")


@pytest.fixture
def driver(start_container: Callable[..., Container]) -> Container:
    return start_container("driver")


@pytest.fixture
def gripper(hand: HandRig, gate: Gate, driver: Container) -> Gripper:
    return hand.active(register=driver.register, deregister=driver.deregister, healthy=gate)


@pytest.fixture
def planner(start_container: Callable[..., Container], gripper: Gripper) -> Container:
    return start_container("planner")


@pytest.fixture
def operator(start_container: Callable[..., Container], gripper: Gripper) -> Container:
    return start_container("operator")


def service(container: Container, name: str) -> Handle:
    return container.find(where(name=name, group="rosie.left.hand"), wait_s=20).with_(deadline_s=60)


def test_S09_an_ended_call_names_its_estop_and_after_a_plain_stop_it_does_not(
    hand: HandRig, gripper: Gripper, planner: Container, operator: Container
) -> None:
    run = service(planner, "close").start(SLOW_M_S)
    hand.under_way()
    report = operator.estop("smoke")
    with pytest.raises(errors.MotionStopped, match=f"before its goal: e-stop {report.id}: smoke") as ended:
        run.result()
    assert "until it is moved again" not in str(ended.value)
    operator.estop_clear([report.id])
    operator.lock_api.resume(HAND_SERVICES)
    run = service(planner, "open").start(SLOW_M_S)
    hand.under_way()
    gripper.stop()
    with pytest.raises(errors.MotionStopped, match=r"before its goal: stop\(\) was called\."):
        run.result()


def test_S14_what_is_withdrawn_while_it_moves_says_so(
    hand: HandRig, gripper: Gripper, planner: Container, driver: Container
) -> None:
    run = service(planner, "close").start(SLOW_M_S)
    hand.under_way()
    driver.deregister(gripper)
    with pytest.raises(errors.MotionStopped, match="before its goal: its services are withdrawn"):
        run.result()


def test_S05_what_is_held_when_its_session_ends_stays_held(
    hand: HandRig, gripper: Gripper, operator: Container
) -> None:
    hand.sim.do(Put(width_m=0.02))
    service(operator, "close")()
    mark = written_now()
    operator.close()
    first = gripper.state()
    wait_until(lambda: gripper.state().measured_at > first.measured_at + 0.3, "it had time")
    assert not hand.writes(mark)
    assert hand.truth.holding
