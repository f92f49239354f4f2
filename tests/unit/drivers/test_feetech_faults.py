"""What happens on a bad bus of Feetech servos, and to servos that protect themselves.

What comes of each fault by itself is in the table of faults.
"""

import pytest

import trade_hil_sim as sim
from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Outcome, written_now
from tests.unit.drivers.tail_rig import TailRig, goal_of, rig, tail
from trade.errors import DeviceFault, DeviceSilent
from trade_drivers import AttachedRobot, MotorState

pytestmark = pytest.mark.virtual_time

__all__ = ["rig", "tail"]

OVERLOAD, OVERHEATING = 0x20, 0x04


@pytest.fixture
def robot(tail: TailRig) -> AttachedRobot:
    return tail.attach()


def state(robot: AttachedRobot, joint: str = "tail.root") -> MotorState | None:
    """The state, or None while it is silent."""
    try:
        return robot.motor(joint).state()
    except DeviceSilent:
        return None


def await_fault(robot: AttachedRobot, says: str) -> None:
    wait_until(lambda: (now := state(robot)) is not None and says in now.fault, f"its fault is {says!r}")


@pytest.mark.parametrize("hex_", ["ff", "ffff01", "ffff0108", "ffff01ff0000"])
def test_garbage_goes_unnoticed(tail: TailRig, robot: AttachedRobot, hex_: str) -> None:
    root = robot.motor("tail.root")
    root.enable()
    tail.sim.do(sim.Garbage(ids=(1,), count=9, hex=hex_))
    assert root.move_to(0.4) == pytest.approx(0.4, abs=0.03)
    assert root.state().fault == ""


def test_a_joint_that_fell_silent_gets_no_command_and_moves_no_farther_than_it_was_sent(
    tail: TailRig, robot: AttachedRobot
) -> None:
    moving = Outcome(lambda: robot.motor("tail.root").move_to(1.3, 1.0))
    wait_until(lambda: tail.truth().position_rad > 0.2, "it is under way")
    tail.sim.do(sim.Mute(ids=(1,)))
    assert isinstance(moving.wait().error, DeviceSilent)
    sent = goal_of(tail.goals(1)[-1])
    wait_until(lambda: not tail.truth().moving, "it rests")
    assert tail.truth().position_counts == sent == goal_of(tail.goals(1)[-1])
    assert tail.truth().position_rad < 1.2


def test_a_joint_that_is_now_another_device_does_not_even_get_a_hold(tail: TailRig, robot: AttachedRobot) -> None:
    root = robot.motor("tail.root")
    root.enable()
    tail.sim.do(sim.Absent(ids=(1,)))
    wait_until(lambda: state(robot) is None, "it is silent")
    tail.sim.do(sim.WrongModel(ids=(1,), number=1285))
    tail.sim.do(sim.Absent(ids=(1,), on=False))
    [axis] = root._axes  # type: ignore[attr-defined]
    wait_until(lambda: "another model" in axis.fault, "it is found out")
    found = written_now()
    with pytest.raises(DeviceSilent):
        root.stop()
    assert not tail.moves(1, found)


def test_a_servo_that_was_too_hot_does_not_come_back_by_itself(tail: TailRig, robot: AttachedRobot) -> None:
    root = robot.motor("tail.root")
    root.move_to(0.3)
    tail.sim.do(sim.Supply(ids=(1,), temperature_c=80))
    await_fault(robot, "overheating")
    wait_until(lambda: not tail.truth().torque, "it is switched off")
    tail.sim.do(sim.Place(ids=(1,), counts=2048))  # it sags
    with pytest.raises(DeviceFault, match="let it cool down"):
        root.enable()
    cooled = written_now()
    tail.sim.do(sim.Supply(ids=(1,), temperature_c=40))
    seen = len(sim.instructions(tail.log, "read", device_id=1))
    wait_until(lambda: len(sim.instructions(tail.log, "read", device_id=1)) > seen + 2, "its health is read again")
    assert not tail.events("motion_started", 1, cooled)
    with pytest.raises(DeviceFault):
        root.move_to(0.1)
    assert not tail.moves(1, cooled)
    root.enable()
    assert root.move_to(0.1) == pytest.approx(0.1, abs=0.03)


def test_a_complaint_that_does_not_cut_torque_leaves_it_on(tail: TailRig, robot: AttachedRobot) -> None:
    robot.motor("tail.root").enable()
    tail.sim.do(sim.Supply(ids=(1,), voltage_v=9.0))
    await_fault(robot, "input voltage")
    assert tail.truth().torque
    assert not tail.events("torque_off", 1)


def test_an_overload_ends_the_move_and_enabling_clears_it(tail: TailRig, robot: AttachedRobot) -> None:
    root = robot.motor("tail.root")
    moving = Outcome(lambda: root.move_to(1.3, 0.3))
    wait_until(lambda: tail.truth().position_rad > 0.1, "it is under way")
    tail.sim.do(sim.HardwareFault(ids=(1,), bits=OVERLOAD))
    error = moving.wait().error
    assert isinstance(error, DeviceFault)
    assert "overload" in str(error)
    wait_until(lambda: not tail.truth().torque, "it is switched off")
    with pytest.raises(DeviceFault, match="overload"):
        root.move_to(0.0)
    root.enable()
    assert root.move_to(0.0) == pytest.approx(0.0, abs=0.03)


def test_an_overload_found_when_attaching_is_cleared_by_enabling(tail: TailRig) -> None:
    tail.poke(40, 1)
    tail.servo().fail(OVERHEATING, written_now())
    tail.servo().fail(OVERLOAD, written_now())
    root = tail.root()
    with pytest.raises(DeviceFault, match="overheating"):
        root.enable()
    assert not tail.truth().torque


def test_enabling_locks_an_EEPROM_that_is_found_open(tail: TailRig, robot: AttachedRobot) -> None:
    tail.poke(55, 0)
    robot.group("tail").enable()
    locking = sim.writes(tail.log, register="lock")
    assert [(entry.device_id, entry.data) for entry in locking] == [(1, b"\1")]


def test_nothing_the_driver_does_touches_an_EEPROM_register(tail: TailRig, robot: AttachedRobot) -> None:
    robot.group("tail").move_to([0.3, 0.2])
    robot.motor("tail.root").stop()
    robot.group("tail").relax()
    robot.close()
    assert all(entry.address is not None and entry.address >= 40 for entry in sim.writes(tail.log))


def test_a_restart_is_noticed_and_only_an_enable_lets_it_move_again(tail: TailRig, robot: AttachedRobot) -> None:
    root = robot.motor("tail.root")
    root.move_to(0.3)
    tail.sim.do(sim.BrownOut(ids=(1,)))
    await_fault(robot, "its torque went off")
    with pytest.raises(DeviceFault):
        root.move_to(0.0)
    root.enable()
    assert root.move_to(0.0) == pytest.approx(0.0, abs=0.03)


@pytest.mark.parametrize("under_way_rad", [0.1, 0.25])
@pytest.mark.parametrize("goal_switches_on", [True, False])
def test_S18_a_servo_that_browns_out_on_its_way_gets_no_goal_after_it_has_booted_limp(
    tail: TailRig, robot: AttachedRobot, under_way_rad: float, goal_switches_on: bool
) -> None:
    tail.servo().goal_switches_on = goal_switches_on
    moving = Outcome(lambda: robot.group("tail").move_to([1.3, 0.4], 0.5))
    wait_until(lambda: tail.truth().position_rad > under_way_rad, "it is under way")
    browned_out = written_now()
    tail.sim.do(sim.BrownOut(ids=(1,)))
    assert isinstance(moving.wait().error, (DeviceFault, DeviceSilent))
    await_fault(robot, "its torque went off")
    booted = tail.wait_for("booted", 1, browned_out)
    assert not tail.moves(1, booted.t)
    assert not tail.truth().torque


def test_S18_a_servo_that_relaxed_and_missed_an_exchange_gets_no_goal(tail: TailRig, robot: AttachedRobot) -> None:
    moving = Outcome(lambda: robot.motor("tail.root").move_to(1.3, 0.5))
    wait_until(lambda: tail.truth().position_rad > 0.2, "it is under way")
    tail.sim.do(sim.Mute(ids=(1,), count=2))
    seen = len(sim.received(tail.log))
    wait_until(lambda: len(sim.received(tail.log)) > seen, "it is asked in vain")
    tail.poke(40, 0)  # back without torque, as one that boots quicker than it is missed
    limp = tail.wait_for("torque_off", 1)
    assert isinstance(moving.wait().error, DeviceFault)
    await_fault(robot, "its torque went off")
    assert not tail.events("torque_on", 1, limp.t)


def test_S18_a_stop_of_a_servo_that_has_booted_limp_and_was_not_heard_since_sends_it_no_hold(
    tail: TailRig, robot: AttachedRobot
) -> None:
    root = robot.motor("tail.root")
    moving = Outcome(lambda: root.move_to(1.3, 0.5))
    wait_until(lambda: tail.truth().position_rad > 0.2, "it is under way")
    tail.sim.do(sim.BrownOut(ids=(1,)))
    tail.sim.do(sim.Mute(ids=(1,)))
    booted = tail.wait_for("booted", 1)
    with pytest.raises(DeviceSilent):
        root.stop()
    assert moving.wait().error is not None
    assert not tail.moves(1, booted.t)
    assert not tail.truth().torque


def test_S07_a_stop_of_a_servo_that_misses_one_exchange_holds_it_as_soon_as_it_is_heard_again(
    tail: TailRig, robot: AttachedRobot
) -> None:
    root = robot.motor("tail.root")
    moving = Outcome(lambda: root.move_to(1.3, 0.5))
    wait_until(lambda: tail.truth().position_rad > 0.2, "it is under way")
    tail.sim.do(sim.Mute(ids=(1,), count=1))
    asked = written_now()
    root.stop()
    assert moving.wait().error is not None
    rested = tail.wait_for("at_rest", 1, asked)
    assert tail.goals(1, asked)
    assert abs(goal_of(tail.goals(1)[-1]) - tail.truth().position_counts) <= 1
    assert tail.truth().position_rad < 0.2 + 0.5 * (rested.t - asked) + 0.2
