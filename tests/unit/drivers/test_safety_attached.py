"""What attaching to servos and leaving them writes: nothing that moves. By the numbers of the rules, S18 to S20."""

import time

import pytest

import trade_hil_sim
from tests.support.simulated_robots import at_rest
from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Outcome, Rig, goal_counts, is_silent, written_now
from trade.errors import (
    DeviceFault,
    MotionStopped,
)
from trade_hil_sim import DynamixelBus

pytestmark = pytest.mark.virtual_time

# --- S18 attach moves and resets nothing


def _enable(sim: DynamixelBus, device_id: int = 1, **goal: int) -> None:
    servo = next(servo for servo in sim.devices if servo.device_id == device_id)
    servo.write(64, b"\1", time.monotonic())
    for counts in goal.values():
        servo.write(112, (5).to_bytes(4, "little") + counts.to_bytes(4, "little"), time.monotonic())


def test_S18_attaching_to_enabled_servos_writes_no_motion(rig: Rig) -> None:
    rig.plug(prepare=_enable)
    robot = rig.attach()
    assert not rig.moves()
    assert robot.motor("neck.pan").state().enabled
    assert rig.truth(1).watchdog == 15


def test_S18_what_is_found_moving_is_stopped(rig: Rig) -> None:
    rig.plug(prepare=lambda sim: _enable(sim, goal=3000))
    rig.wait_for("motion_started", 1)
    rig.attach()
    rig.wait_for("at_rest", 1)
    assert rig.truth(1).position_counts < 2900
    assert abs(goal_counts(rig.goals(1)[-1]) - rig.truth(1).position_counts) <= 3
    assert not rig.goals(2)


def test_S18_enabling_seeds_the_goal_with_the_measured_position(rig: Rig) -> None:
    rig.plug()
    robot = rig.attach()
    rig.sim.do(trade_hil_sim.Place(ids=(1,), counts=2400))
    wait_until(lambda: robot.motor("neck.pan").state().position_rad > 0.5, "the new place is measured")
    robot.motor("neck.pan").enable()
    first = rig.moves(1)[0]
    assert "goal_position" in first.registers
    assert "torque_enable" not in first.registers
    assert goal_counts(first) == 2400
    assert rig.truth(1).position_counts == 2400
    assert not rig.events("motion_started", 1)


def test_S18_replugging_never_enables_and_never_commands(head: Rig) -> None:
    robot = head.attach()
    robot.motor("neck.pan").move_to(0.3)
    mark = written_now()
    head.sim.do(trade_hil_sim.Unplug())
    wait_until(lambda: is_silent(robot, "neck.pan"), "the driver noticed")
    head.sim.do(trade_hil_sim.Replug())
    wait_until(lambda: not is_silent(robot, "neck.pan"), "the driver is back")
    assert not head.moves(since=mark)


# --- S19 leaving


def test_S19_shutdown_with_hold_keeps_torque_on_and_disarms_the_watchdog(head: Rig) -> None:
    with head.attach() as robot:
        robot.motor("neck.pan").move_to(0.3)
        mark = written_now()
    assert head.truth(1).torque
    assert head.truth(1).watchdog == 0
    assert not head.truth(2).torque
    assert not head.moves(since=mark)
    assert not head.events("watchdog_expired")


def test_S19_shutdown_with_relax_switches_torque_off(rig: Rig) -> None:
    rig.configure(('driver = "dynamixel"', 'driver = "dynamixel"\nleave = "relax"'))
    rig.plug()
    with rig.attach() as robot:
        robot.motor("neck.pan").move_to(0.3)
    assert not rig.truth(1).torque


def test_S19_shutdown_while_moving_stops_first(head: Rig) -> None:
    robot = head.attach()
    moving = Outcome(lambda: robot.motor("neck.pan").move_to(1.3, 0.2))
    head.wait_for("motion_started", 1)
    robot.close()
    robot.close()
    assert isinstance(moving.wait().error, MotionStopped)
    assert at_rest(head.truth(1))
    assert head.truth(1).position_rad < 1.0
    with pytest.raises(DeviceFault, match="ended"):
        robot.motor("neck.pan").move_to(0.0)


def test_S19_a_joint_that_cannot_be_heard_keeps_its_watchdog(head: Rig) -> None:
    robot = head.attach()
    robot.group("head").enable()
    head.sim.do(trade_hil_sim.Mute(ids=(1,)))
    wait_until(lambda: is_silent(robot, "neck.pan"), "it is silent")
    robot.close()
    assert robot.unseen() == ["rosie.neck.pan"]
    assert head.truth(2).watchdog == 0
    head.wait_for("watchdog_expired", 1)


def test_S19_a_joint_that_falls_silent_during_the_shutdown_is_only_reported(head: Rig) -> None:
    robot = head.attach()
    robot.group("head").enable()
    head.sim.do(trade_hil_sim.Mute(ids=(1,)))
    robot.close()
    assert robot.unseen() == ["rosie.neck.pan"]
    assert head.truth(2).watchdog == 0


# --- S20 never twice


def test_S20_the_port_is_free_again_after_close(head: Rig) -> None:
    head.attach().close()
    head.attach()
