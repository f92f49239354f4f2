"""What a motor and a group do on the bus, beyond their contracts."""

import pytest

from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Outcome, Rig, goal_counts, written_now
from trade.errors import InvalidArgument, MotionStopped
from trade_drivers import AttachedRobot

pytestmark = pytest.mark.virtual_time


def test_joints_and_groups_become_providers_in_groups_named_after_them(head: Rig, robot: AttachedRobot) -> None:
    assert head.announced == [("rosie.neck.pan",), ("rosie.neck.tilt",), ("rosie.head",), ("rosie.faults",)]
    assert [one.name for one in robot.group("head").resources] == ["rosie.neck.pan", "rosie.neck.tilt"]
    assert robot.group("head").resources[0] is robot.motor("neck.pan").resources[0]
    assert robot.group("head").joints() == ["rosie.neck.pan", "rosie.neck.tilt"]


def test_a_reversed_joint_turns_the_device_the_other_way(head: Rig, robot: AttachedRobot) -> None:
    robot.motor("neck.tilt").move_to(0.3)
    assert head.truth(2).position_counts == pytest.approx(2048 - 0.3 * 4096 / 6.283185, abs=4)
    assert head.truth(2).position_rad == pytest.approx(0.3, abs=0.01)


def test_an_offset_shifts_the_joint_against_its_device(rig: Rig) -> None:
    rig.configure(("id = 1", "id = 1\noffset_rad = 0.5"))
    rig.plug()
    robot = rig.attach()
    robot.motor("neck.pan").move_to(0.5)
    assert rig.truth(1).position_counts == pytest.approx(2048, abs=4)


def test_a_move_uses_the_limits_for_speed_and_acceleration(head: Rig, robot: AttachedRobot) -> None:
    robot.motor("neck.pan").move_to(0.8)
    sent = head.goals(1)[-1].data
    accel, speed = int.from_bytes(sent[0:4], "little"), int.from_bytes(sent[4:8], "little")
    assert 0 < speed * 0.0239808 <= 2.5
    assert 0 < accel * 0.374508 <= 20.0


def test_a_group_starts_in_one_packet_and_arrives_together(head: Rig, robot: AttachedRobot) -> None:
    group = robot.group("head")
    group.enable()
    mark = written_now()
    assert group.move_to([-1.2, 0.3]) == pytest.approx([-1.2, 0.3], abs=0.03)
    first, second = head.goals(since=mark)
    assert first.t == second.t
    wait_until(lambda: all(head.events("at_rest", i, mark) for i in (1, 2)), "both joints rest")
    started = [head.events("motion_started", i, mark)[0].t for i in (1, 2)]
    arrived = [head.events("at_rest", i, mark)[0].t for i in (1, 2)]
    duration = max(arrived) - min(started)
    assert abs(arrived[0] - arrived[1]) < 0.15 * duration


def test_a_group_refuses_another_number_of_values(head: Rig, robot: AttachedRobot) -> None:
    for values in ([], [0.1], [0.1, 0.1, 0.1]):
        with pytest.raises(InvalidArgument, match="it takes 2"):
            robot.group("head").move_to(values)
    assert not head.moves()


def test_a_new_move_takes_over_and_the_old_caller_hears_of_it(head: Rig, robot: AttachedRobot) -> None:
    pan = robot.motor("neck.pan")
    old = Outcome(lambda: pan.move_to(1.3, 0.2))
    head.wait_for("motion_started", 1)
    assert pan.move_to(0.0) == pytest.approx(0.0, abs=0.03)
    assert isinstance(old.wait().error, MotionStopped)
    assert "another move" in str(old.error)


def test_taking_one_joint_out_of_a_moving_group_holds_the_others(head: Rig, robot: AttachedRobot) -> None:
    old = Outcome(lambda: robot.group("head").move_to([1.3, 0.5], 0.2))
    head.wait_for("motion_started", 2)
    mark = written_now()
    robot.motor("neck.pan").move_to(0.0)
    assert isinstance(old.wait().error, MotionStopped)
    wait_until(lambda: not head.truth(2).moving, "the tilt joint rests")
    assert goal_counts(head.goals(2, mark)[-1]) == head.truth(2).position_counts
    assert abs(head.truth(2).position_rad) < 0.4


def test_stopping_one_joint_of_a_moving_group_stops_them_all(head: Rig, robot: AttachedRobot) -> None:
    moving = Outcome(lambda: robot.group("head").move_to([1.3, 0.5], 0.2))
    head.wait_for("motion_started", 2)
    robot.motor("neck.pan").stop()
    assert isinstance(moving.wait().error, MotionStopped)
    wait_until(lambda: not head.truth(2).moving, "the tilt joint rests")
    assert head.truth(2).position_rad < 0.4


def test_relaxing_a_moving_joint_ends_its_move(head: Rig, robot: AttachedRobot) -> None:
    pan = robot.motor("neck.pan")
    moving = Outcome(lambda: pan.move_to(1.3, 0.2))
    head.wait_for("motion_started", 1)
    pan.relax()
    assert isinstance(moving.wait().error, MotionStopped)
    assert not head.truth(1).torque


def test_a_deadline_that_passes_on_the_way_stops_the_joint(head: Rig, robot: AttachedRobot) -> None:
    pan = robot.motor("neck.pan")
    pan.enable()
    moving = Outcome(lambda: pan.move_to(1.3, 0.1), deadline_s=0.5).wait()
    assert isinstance(moving.error, MotionStopped)
    assert "deadline" in str(moving.error)
    wait_until(lambda: not head.truth(1).moving, "the joint rests")
    assert head.truth(1).position_rad < 1.0


def test_enabling_an_enabled_joint_does_not_disturb_its_move(head: Rig, robot: AttachedRobot) -> None:
    pan = robot.motor("neck.pan")
    pan.enable()
    moving = Outcome(lambda: pan.move_to(0.5, 1.0))
    head.wait_for("motion_started", 1)
    pan.enable()
    assert moving.wait().result == pytest.approx(0.5, abs=0.03)
