"""What happens to a gripper on a bad bus, and when the device itself fails, beyond what is in the table of faults."""

import pytest

import trade_hil_sim as sim
from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Outcome, written_now
from tests.unit.drivers.gripper_rig import HandRig, hand, rig
from trade.errors import BusGone, DeviceError, DeviceSilent, TradeError
from trade_drivers import Gripper, GripperState

pytestmark = pytest.mark.virtual_time

__all__ = ["hand", "rig"]

SLOW_M_S = 0.02


@pytest.fixture
def gripper(hand: HandRig) -> Gripper:
    return hand.active()


def state(gripper: Gripper) -> GripperState | None:
    """The state, or None while it is silent."""
    try:
        return gripper.state()
    except DeviceSilent:
        return None


def closing(hand: HandRig, gripper: Gripper) -> Outcome:
    """A slow move that has begun."""
    moving = Outcome(lambda: gripper.close(SLOW_M_S))
    hand.under_way()
    return moving


@pytest.mark.parametrize(
    "fault",
    [
        sim.Mute(count=1),
        sim.Truncate(count=1),
        sim.Duplicate(count=3),
        sim.Dribble(count=3, s=0.0005),
        sim.Mute(count=1, instruction="read_write"),
        sim.BadCrc(count=2, instruction="read_write"),
        sim.Echo(),
    ],
    ids=repr,
)
def test_a_single_bad_answer_goes_unnoticed(hand: HandRig, gripper: Gripper, fault: sim.Command) -> None:
    hand.sim.do(fault)
    assert gripper.move_to(0.03).width_m == pytest.approx(0.03, abs=0.001)
    assert gripper.state().fault == ""


def test_a_gripper_has_as_long_to_answer_as_its_measurements_may_be_old(rig: HandRig) -> None:
    rig.configure(("baud = 115200", "baud = 115200\nstale_after_s = 2"))
    rig.plug()
    gripper = rig.active()
    moving = closing(rig, gripper)
    rig.sim.do(sim.Mute(count=6))
    assert moving.wait().result.width_m == pytest.approx(0, abs=0.003)
    rig.sim.do(sim.Mute(count=6))
    assert gripper.open().width_m == pytest.approx(0.085, abs=0.003)


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("late_s", [0.036, 0.05, 0.065, 0.07, 0.08, 0.1])
def test_a_late_answer_never_becomes_a_wrong_value(hand: HandRig, gripper: Gripper, late_s: float, count: int) -> None:
    gripper.close()
    hand.sim.do(sim.Late(s=late_s, count=count))
    struck = len(sim.instructions(hand.log))
    wait_until(lambda: len(sim.instructions(hand.log)) > struck + 1, "an answer is on its way, late")
    gripper.open()
    opened = written_now()

    def plausible() -> bool:
        now = state(gripper)
        assert now is None or now.measured_at < opened or now.width_m > 0.08
        return now is not None and now.measured_at > opened + 0.4

    wait_until(plausible, "later measurements came in")


def test_an_object_in_the_way_of_activation_does_not_block_without_end(hand: HandRig) -> None:
    gripper = hand.gripper()
    hand.sim.do(sim.Jam())
    assert gripper.activate().activated


def test_fingers_held_fast_are_holding(hand: HandRig, gripper: Gripper) -> None:
    hand.sim.do(sim.Jam())
    assert gripper.close().holding == "outside"


@pytest.mark.realtime
def test_clear_fault_reports_a_fault_that_stays(hand: HandRig, gripper: Gripper) -> None:
    hand.sim.do(sim.Mute(instruction="read_write"))
    with pytest.raises(DeviceSilent):
        gripper.clear_fault()
    hand.sim.do(sim.Heal())
    wait_until(lambda: state(gripper) is not None, "it answers")
    gripper.clear_fault()
    assert not gripper.state().activated


def test_clearing_a_fault_moves_nothing(hand: HandRig, gripper: Gripper) -> None:
    moving = closing(hand, gripper)
    mark = written_now()
    gripper.clear_fault()
    assert isinstance(moving.wait().error, TradeError)
    assert not hand.moves(mark)
    assert not hand.truth.moving
    assert not gripper.state().activated


def test_an_unplugged_bus_is_named_and_comes_back_by_itself(hand: HandRig, gripper: Gripper) -> None:
    gripper.close()
    mark = written_now()
    hand.sim.do(sim.Unplug())
    wait_until(lambda: state(gripper) is None, "it is silent")
    for act in (gripper.state, gripper.open, gripper.activate, gripper.stop, gripper.clear_fault):
        with pytest.raises(BusGone):
            act()
    hand.sim.do(sim.Replug())
    wait_until(lambda: state(gripper) is not None, "it answers")
    assert not hand.writes(mark)
    assert gripper.open().width_m == pytest.approx(0.085, abs=0.001)


def test_fingers_that_still_move_when_the_bus_is_back_are_stopped(hand: HandRig, gripper: Gripper) -> None:
    moving = closing(hand, gripper)
    hand.sim.do(sim.Unplug())
    assert isinstance(moving.wait().error, BusGone)
    mark = written_now()
    hand.sim.do(sim.Replug())
    wait_until(lambda: hand.writes(mark), "it is stopped")
    wait_until(lambda: not hand.truth.moving, "it is at rest")
    assert not hand.moves(mark)
    assert hand.truth.width_m > 0.005


def test_closing_while_unplugged_ends_all_the_same(hand: HandRig) -> None:
    robot = hand.attach()
    hand.sim.do(sim.Unplug())
    wait_until(lambda: state(robot.gripper("left.hand")) is None, "it is silent")
    with pytest.raises(DeviceError):
        robot.close()
    robot.close()
