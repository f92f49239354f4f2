"""What happens on a bad bus: no bad answer is believed, and no device suffers for another.

What comes of each fault by itself is in the table of faults.
"""

import time
from contextlib import suppress

import pytest

import trade_hil_sim as sim
from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Outcome, Rig, goal_counts, written_now
from trade import permit
from trade.errors import BusGone, DeviceFault, DeviceSilent
from trade_drivers import AttachedRobot, MotorState
from trade_drivers.bus._gate import Terms
from trade_drivers.joints._jobs import Enable, Relax
from trade_drivers.vendors.dynamixel import DynamixelDriver

pytestmark = pytest.mark.virtual_time

COUNT_RAD = 6.283185 / 4096


def state(robot: AttachedRobot, joint: str) -> MotorState | None:
    """The state, or None while it is silent."""
    try:
        return robot.motor(joint).state()
    except DeviceSilent:
        return None


def await_silence(robot: AttachedRobot, joint: str) -> None:
    wait_until(lambda: state(robot, joint) is None, f"{joint} is silent")


def await_answers(robot: AttachedRobot, joint: str) -> None:
    wait_until(lambda: state(robot, joint) is not None, f"{joint} answers")


def test_a_silent_joint_is_an_error_with_its_name_and_never_a_zero(head: Rig, robot: AttachedRobot) -> None:
    robot.motor("neck.pan").move_to(0.5)
    head.sim.do(sim.Mute(ids=(1,)))
    seen: set[float] = set()

    def silent() -> bool:
        now = state(robot, "neck.pan")
        if now is not None:
            seen.add(round(now.position_rad, 2))
        return now is None

    wait_until(silent, "it is silent")
    assert seen <= {0.5}
    with pytest.raises(DeviceSilent, match=r"rosie\.neck\.pan did not answer") as deaf:
        robot.motor("neck.pan").state()
    assert deaf.value.waited_s > 0.25


def test_a_silent_joint_does_not_let_the_watchdog_of_a_moving_one_expire(head: Rig, robot: AttachedRobot) -> None:
    moving = Outcome(lambda: robot.motor("neck.tilt").move_to(0.5, 0.5))
    head.wait_for("motion_started", 2)
    head.sim.do(sim.Mute(ids=(1,)))
    assert moving.wait().result == pytest.approx(0.5, abs=0.03)
    assert not head.events("watchdog_expired", 2)


def test_a_joint_that_falls_silent_ends_the_move_of_its_group_and_the_others_hold(
    head: Rig, robot: AttachedRobot
) -> None:
    moving = Outcome(lambda: robot.group("head").move_to([1.3, 0.5], 0.2))
    head.wait_for("motion_started", 2)
    head.sim.do(sim.Mute(ids=(1,)))
    assert isinstance(moving.wait().error, DeviceSilent)
    assert "neck.pan" in str(moving.error)
    wait_until(lambda: not head.truth(2).moving, "the tilt joint rests")
    assert head.truth(2).position_rad < 0.45


def test_stopping_a_silent_joint_is_tried_and_reported(head: Rig, robot: AttachedRobot) -> None:
    moving = Outcome(lambda: robot.motor("neck.pan").move_to(1.3, 0.1))
    wait_until(lambda: head.truth(1).position_rad > 0.03, "it is under way")
    head.sim.do(sim.Mute(ids=(1,)))
    with pytest.raises(DeviceSilent):
        robot.motor("neck.pan").stop()
    assert moving.wait().error is not None
    wait_until(lambda: not head.truth(1).moving, "it rests")
    assert head.truth(1).position_rad < 0.5


def test_stopping_a_silent_joint_once_more_does_not_turn_it_back(head: Rig, robot: AttachedRobot) -> None:
    moving = Outcome(lambda: robot.motor("neck.pan").move_to(1.3, 1.0))
    wait_until(lambda: head.truth(1).position_rad > 0.2, "it is under way")
    mark = written_now()
    head.sim.do(sim.Mute(ids=(1,)))
    assert isinstance(moving.wait().error, DeviceSilent)
    wait_until(lambda: head.goals(1, mark), "it gets a command to hold")
    held = [goal_counts(entry) for entry in head.goals(1, mark)]
    with pytest.raises(DeviceSilent):
        robot.motor("neck.pan").stop()
    wait_until(lambda: len(head.goals(1, mark)) > len(held), "it gets another command to hold")
    assert {goal_counts(entry) for entry in head.goals(1, mark)} == set(held)


PATIENT = ('port = "/dev/ttyNOWHERE"', 'port = "/dev/ttyNOWHERE"\nstale_after_s = 2\nwatchdog_s = 2')


def test_a_joint_that_misses_answers_is_not_silent_before_its_measurements_are_stale(rig: Rig) -> None:
    rig.configure(PATIENT)
    rig.plug()
    pan = rig.attach().motor("neck.pan")
    moving = Outcome(lambda: pan.move_to(0.5, 0.5))
    rig.wait_for("motion_started", 1)
    rig.sim.do(sim.Mute(ids=(1,), count=5))
    assert moving.wait().result == pytest.approx(0.5, abs=0.03)


def test_a_joint_at_its_goal_is_not_blocked_while_another_one_is_not_heard(rig: Rig) -> None:
    rig.configure(PATIENT)
    rig.plug()
    group = rig.attach().group("head")
    group.enable()
    mark = written_now()
    moving = Outcome(lambda: group.move_to([0.05, 0.05]))
    rig.wait_for("motion_started", 1, mark)
    rig.sim.do(sim.Mute(ids=(1,), count=10))  # for longer than the move may take while it is measured
    assert moving.wait().result == pytest.approx([0.05, 0.05], abs=0.01)


def test_enabling_gives_a_joint_as_long_to_answer_as_its_measurements_may_be_old(rig: Rig) -> None:
    rig.configure(PATIENT)
    rig.plug()
    pan = rig.attach().motor("neck.pan")
    rig.sim.do(sim.Mute(ids=(1,), instruction="write", count=5))
    pan.enable()
    assert rig.truth(1).torque


@pytest.mark.parametrize("late_s", [0.04, 0.07, 0.075, 0.08, 0.085, 0.09, 0.1, 0.12])
def test_a_late_position_is_not_taken_for_a_new_one(head: Rig, robot: AttachedRobot, late_s: float) -> None:
    head.sim.do(sim.Late(ids=(1,), s=late_s, count=1, instruction="sync_read"))
    struck = len(sim.instructions(head.log, "sync_read"))
    wait_until(lambda: len(sim.instructions(head.log, "sync_read")) > struck, "an answer is on its way, late")
    head.sim.do(sim.Place(ids=(1,), counts=2500))
    moved = written_now()

    def measured_again() -> bool:
        now = state(robot, "neck.pan")
        fresh = now is not None and now.measured_at > moved
        assert now is None or not fresh or now.position_rad == pytest.approx(452 * COUNT_RAD, abs=0.01)
        return now is not None and now.measured_at > moved + 0.2

    wait_until(measured_again, "later measurements came in")


@pytest.mark.parametrize("late_s", [0.06, 0.1, 0.15, 0.3, 0.6])
def test_answers_that_are_late_for_as_long_as_they_may_be_are_not_taken_for_new_ones(rig: Rig, late_s: float) -> None:
    rig.configure(PATIENT)
    rig.plug()
    robot = rig.attach()
    rig.sim.do(sim.Late(ids=(1,), s=late_s))
    asked = written_now()
    wait_until(lambda: len(sim.instructions(rig.log, "ping", since=asked)) > 3, "its answers are late")
    rig.sim.do(sim.Place(ids=(1,), counts=2500))
    moved = written_now()

    def measured_again() -> bool:
        now = state(robot, "neck.pan")
        fresh = now is not None and now.measured_at > moved
        assert now is None or not fresh or now.position_rad == pytest.approx(452 * COUNT_RAD, abs=0.01)
        return fresh

    until = written_now() + 3
    wait_until(lambda: measured_again() or written_now() > until, "its measurements are too old")
    rig.sim.do(sim.Heal())
    wait_until(measured_again, "it is measured again")


def test_enabling_copes_with_an_answer_lost(head: Rig, robot: AttachedRobot) -> None:
    head.sim.do(sim.Mute(ids=(1,), instruction="write", count=2))
    robot.motor("neck.pan").enable()
    assert head.truth(1).torque


def test_an_unplugged_bus_is_named_and_comes_back_by_itself(head: Rig, robot: AttachedRobot) -> None:
    robot.motor("neck.pan").move_to(0.3)
    head.sim.do(sim.Unplug())
    await_silence(robot, "neck.pan")
    with pytest.raises(BusGone, match="plug its adapter in again") as gone:
        robot.motor("neck.pan").state()
    assert gone.value.bus == str(head.sim.port)
    for act in (lambda: robot.motor("neck.pan").move_to(0.1), robot.motor("neck.pan").enable):
        with pytest.raises(BusGone):
            act()
    head.sim.do(sim.Replug())
    await_answers(robot, "neck.pan")
    assert state(robot, "neck.tilt") is not None


def test_a_stop_while_unplugged_is_not_written_after_replugging(head: Rig, robot: AttachedRobot) -> None:
    robot.motor("neck.pan").enable()
    head.sim.do(sim.Unplug())
    await_silence(robot, "neck.pan")
    mark = written_now()
    with pytest.raises(BusGone):
        robot.motor("neck.pan").stop()
    head.sim.do(sim.Replug())
    await_answers(robot, "neck.pan")
    assert not head.moves(since=mark)


def test_another_device_after_replugging_is_not_used(head: Rig, robot: AttachedRobot) -> None:
    head.sim.do(sim.Unplug())
    await_silence(robot, "neck.pan")
    head.sim.do(sim.WrongModel(ids=(1,), number=1020))
    head.sim.do(sim.Replug())
    await_answers(robot, "neck.tilt")
    mark = written_now()
    with pytest.raises((DeviceFault, DeviceSilent)):
        robot.motor("neck.pan").move_to(0.1)
    assert not head.moves(1, mark)


def test_closing_while_unplugged_ends_all_the_same(head: Rig, robot: AttachedRobot) -> None:
    head.sim.do(sim.Unplug())
    await_silence(robot, "neck.pan")
    with pytest.raises(BusGone):
        robot.close()
    robot.close()


def test_a_hardware_error_ends_the_move_and_is_named(head: Rig, robot: AttachedRobot) -> None:
    moving = Outcome(lambda: robot.motor("neck.pan").move_to(1.3, 0.1))
    head.wait_for("motion_started", 1)
    head.sim.do(sim.HardwareFault(ids=(1,), bits=0x20))
    assert "overload" in str(moving.wait().error)
    with pytest.raises(DeviceFault, match="overload"):
        robot.motor("neck.pan").move_to(1.3, 0.1)


def test_health_that_is_read_while_a_joint_is_being_relaxed_is_no_fault(head: Rig) -> None:
    exchange = DynamixelDriver().open_exchange(head.robot, head.robot.buses[0], str(head.sim.port))
    exchange.period_ns = 0  # one step of its work in each cycle
    try:
        for kind in (Enable, Relax):
            with permit([axis.resource for axis in exchange.devices]) as permitted:
                job = kind(exchange, exchange.devices, Terms("test", 2**63, None, permitted))
                exchange.submit(job)
                while not job.ended:
                    for axis in exchange.devices:
                        axis.health_due_ns = 2**63
                    exchange.devices[0].health_due_ns = 0  # it is looked at in every cycle
                    exchange.cycle()
            job.wait(lambda: True)
        assert not any(axis.fault for axis in exchange.devices)
    finally:
        exchange.wire.close()


def test_enabling_alone_reboots_a_servo_that_has_shut_down(head: Rig, robot: AttachedRobot) -> None:
    pan, tilt = robot.motor("neck.pan"), robot.motor("neck.tilt")
    pan.move_to(0.2)
    head.sim.do(sim.HardwareFault(ids=(1,), bits=0x20))
    wait_until(lambda: "overload" in pan.state().fault, "its fault is reported")
    for act in (lambda: pan.move_to(0.1), pan.stop, pan.relax):
        with suppress(DeviceFault):
            act()
    assert not sim.instructions(head.log, "reboot")
    tilting = Outcome(lambda: tilt.move_to(0.5, 0.3))
    wait_until(lambda: head.truth(2).moving, "the other one is under way")
    pan.enable()
    assert len(sim.instructions(head.log, "reboot")) == 1
    assert pan.move_to(0.1) == pytest.approx(0.1, abs=0.03)
    assert tilting.wait().error is None


def test_a_servo_whose_fault_comes_back_at_once_is_not_enabled(head: Rig, robot: AttachedRobot) -> None:
    pan = robot.motor("neck.pan")
    head.sim.do(sim.Supply(ids=(1,), temperature_c=90))
    wait_until(lambda: "overheating" in pan.state().fault, "its fault is reported")
    with pytest.raises(DeviceFault, match="overheating"):
        pan.enable()
    assert not head.truth(1).torque


def test_a_faulty_servo_with_torque_on_is_not_rebooted(head: Rig, robot: AttachedRobot) -> None:
    pan = robot.motor("neck.pan")
    pan.relax()
    head.sim.devices[0].write(63, b"\0", time.monotonic())  # shut down for nothing
    pan.enable()
    head.sim.do(sim.HardwareFault(ids=(1,), bits=0x20))
    wait_until(lambda: "overload" in pan.state().fault, "its fault is reported")
    with pytest.raises(DeviceFault, match=r"it has not let go: call relax\(\)"):
        pan.enable()
    assert head.truth(1).torque
    pan.relax()
    pan.enable()
