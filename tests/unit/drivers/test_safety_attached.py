"""What attaching to servos and leaving them writes: nothing that moves. By the numbers of the rules, S18 to S20."""

import time

import pytest

import trade_hil_sim
from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Rig, goal_counts, is_silent
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


# --- S19 leaving


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
