"""What happens to a gripper on a bad bus, and when the device itself fails: expected state, error, stop, recovery."""

from collections.abc import Iterator
from pathlib import Path

import pytest

import trade_hil_sim as sim
from drivers.conftest import Outcome, written_now
from drivers.gripper_rig import HandRig, made_rig
from trade.errors import BusGone, DeviceError, DeviceFault, DeviceSilent, TradeError
from trade_drivers import Gripper, GripperState
from waiting import wait_until

SLOW_M_S = 0.02


@pytest.fixture
def hand(tmp_path: Path) -> Iterator[HandRig]:
    with made_rig(tmp_path) as made:
        made.plug()
        yield made


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
    wait_until(lambda: hand.truth.moving and hand.truth.width_m < 0.083, "it is under way")
    return moving


# --- the table: what strikes a move, what its caller hears, whether it answers afterwards


TABLE = [
    ("silence", [sim.Mute()], DeviceSilent, "did not answer", [sim.Heal()]),
    ("damaged answers", [sim.BadCrc()], DeviceSilent, "did not answer", [sim.Heal()]),
    ("answers cut short", [sim.Truncate()], DeviceSilent, "did not answer", [sim.Heal()]),
    ("answers too late", [sim.Late(s=0.5)], DeviceSilent, "did not answer", [sim.Heal()]),
    ("off the bus", [sim.Absent()], DeviceSilent, "did not answer", [sim.Heal()]),
    ("unplugged", [sim.Unplug()], BusGone, "plug its adapter in again", [sim.Replug()]),
    ("frozen value", [sim.Freeze()], DeviceFault, "its fingers stand", [sim.Heal()]),
    ("brown-out", [sim.BrownOut()], DeviceFault, "activat", []),
    ("overcurrent", [sim.HardwareFault(bits=0x0E)], DeviceFault, "overcurrent", []),
    ("under-voltage", [sim.HardwareFault(bits=0x0A)], DeviceFault, "supply voltage is too low", []),
    ("too hot", [sim.HardwareFault(bits=0x08)], DeviceFault, "too hot", [sim.Heal()]),
]


@pytest.mark.parametrize(
    ("strike", "error", "text", "cure"), [row[1:] for row in TABLE], ids=[str(row[0]) for row in TABLE]
)
def test_a_move_that_is_struck_ends_and_nothing_moves_until_somebody_asks(
    hand: HandRig,
    gripper: Gripper,
    strike: list[sim.Command],
    error: type[TradeError],
    text: str,
    cure: list[sim.Command],
) -> None:
    moving = closing(hand, gripper)
    mark = written_now()
    for order in strike:
        hand.sim.do(order)
    assert isinstance(moving.wait().error, error)
    assert text in str(moving.error)
    if error is not BusGone and not isinstance(strike[0], sim.Absent):  # else no stop can reach it
        wait_until(lambda: not hand.truth.moving, "it stands")
    if error is DeviceFault:
        with pytest.raises(DeviceFault, match=text):
            gripper.open()
    for order in cure:
        hand.sim.do(order)
    wait_until(lambda: state(gripper) is not None, "it answers")
    wait_until(lambda: not hand.truth.moving, "it stands")
    assert not hand.moves(mark)
    gripper.clear_fault()
    gripper.activate()
    assert gripper.open().width_m == pytest.approx(0.085, abs=0.001)


@pytest.mark.parametrize(
    "fault",
    [
        sim.Mute(count=1),
        sim.BadCrc(count=1),
        sim.Truncate(count=1),
        sim.Late(count=1, s=0.06),
        sim.Garbage(count=3, hex="09040600ff"),
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


def test_an_object_in_the_way_of_activation_is_no_reason_to_wait_for_ever(hand: HandRig) -> None:
    gripper = hand.gripper()
    hand.sim.do(sim.Jam())
    assert gripper.activate().activated


def test_fingers_held_fast_are_holding(hand: HandRig, gripper: Gripper) -> None:
    hand.sim.do(sim.Jam())
    assert gripper.close().holding == "outside"


def test_a_fault_that_stays_is_told_by_clear_fault(hand: HandRig, gripper: Gripper) -> None:
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
    wait_until(lambda: not hand.truth.moving, "it stands")
    assert not hand.moves(mark)
    assert hand.truth.width_m > 0.005


def test_closing_while_unplugged_ends_all_the_same(hand: HandRig) -> None:
    robot = hand.attach()
    hand.sim.do(sim.Unplug())
    wait_until(lambda: state(robot.gripper("left.hand")) is None, "it is silent")
    with pytest.raises(DeviceError):
        robot.close()
    robot.close()
