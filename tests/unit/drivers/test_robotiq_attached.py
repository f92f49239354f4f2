"""What attaching to a gripper writes, and that nothing but `activate` activates it: rules S18 and S19."""

import time

import pytest

from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Outcome, written_now
from tests.unit.drivers.gripper_rig import HandRig, hand, rig, silent
from trade.errors import (
    DeviceFault,
)
from trade_hil_sim import BrownOut, Heal, Mute, Put, Replug, RobotiqBus, Unplug, events

pytestmark = pytest.mark.virtual_time

__all__ = ["hand", "rig"]

SLOW_M_S = 0.02


def tell(bus: RobotiqBus, *values: int) -> None:
    """What another client wrote before."""
    bus.devices[0].write(0x03E8, values, time.monotonic())
    bus._line.nudge()


def test_S18_attaching_to_a_gripper_that_holds_something_leaves_it_so(hand: HandRig) -> None:
    hand.sim.do(Put(width_m=0.04))
    tell(hand.sim, 0x0100, 0, 0)
    hand.wait_for("activated")
    tell(hand.sim, 0x0900, 255, 0xFFFF)
    wait_until(lambda: hand.truth.holding, "it holds")
    assert hand.gripper().state().holding == "outside"
    assert not hand.writes()


def test_S18_a_gripper_found_moving_is_stopped(hand: HandRig) -> None:
    tell(hand.sim, 0x0100, 0, 0)
    hand.wait_for("activated")
    tell(hand.sim, 0x0900, 255, 0x00FF)
    hand.under_way()
    hand.gripper()
    wait_until(lambda: not hand.truth.moving, "it is at rest")
    assert not hand.moves()
    assert hand.truth.activated
    assert hand.truth.width_m > 0.02


def test_S18_a_gripper_found_activating_is_stopped(hand: HandRig) -> None:
    tell(hand.sim, 0x0100, 0, 0)
    wait_until(lambda: hand.truth.moving, "its fingers move")
    hand.gripper()
    wait_until(lambda: not hand.truth.moving, "it is at rest")
    assert not hand.moves()
    assert not hand.truth.activated


@pytest.mark.parametrize("what", ["attach", "brown-out", "replug", "silence"])
def test_S19_nothing_but_activate_ever_activates(hand: HandRig, what: str) -> None:
    gripper = hand.gripper() if what == "attach" else hand.active()
    mark = written_now()
    match what:
        case "brown-out":
            hand.sim.do(BrownOut())
        case "replug":
            hand.sim.do(Unplug())
            hand.sim.do(BrownOut())
            hand.sim.do(Replug())
        case "silence":
            hand.sim.do(Mute())
            hand.sim.do(BrownOut())
            wait_until(lambda: silent(gripper), "it is silent")
            hand.sim.do(Heal())
        case _:
            pass
    wait_until(lambda: not silent(gripper) and not gripper.state().activated, "it is back")
    gripper.stop()
    for act in (gripper.close, gripper.open, lambda: gripper.move_to(0.04)):
        with pytest.raises(DeviceFault, match=r"call activate\(\): it moves the fingers"):
            act()
    assert not hand.moves(mark)
    assert gripper.activate().activated
    assert events(hand.log, "activating", since=mark)


def test_S19_a_brown_out_in_the_middle_of_a_move_ends_it_and_its_stop_does_not_activate(hand: HandRig) -> None:
    gripper = hand.active()
    moving = Outcome(lambda: gripper.close(SLOW_M_S))
    hand.under_way()
    mark = written_now()
    hand.sim.do(BrownOut())
    assert isinstance(moving.wait().error, DeviceFault)
    assert "lost its activation" in str(moving.error)
    first = gripper.state()
    wait_until(lambda: gripper.state().measured_at > first.measured_at + 0.2, "it had time")
    assert not hand.moves(mark)
    assert not events(hand.log, "activating", since=mark)
