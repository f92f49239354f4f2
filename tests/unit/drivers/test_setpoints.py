"""Set-points: what they move, and what ends them; the judge is what the simulated servos received and did."""

import math
from collections.abc import Callable
from contextlib import suppress

import pytest

from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Outcome, Rig, goal_counts, written_now
from tests.unit.drivers.gate import Gate
from trade.errors import InvalidArgument, LimitExceeded, MotionStopped, TradeError
from trade_drivers import AttachedRobot, Motor
from trade_hil_sim import BrownOut, Servo

pytestmark = pytest.mark.realtime

COUNTS_PER_RAD = 4096 / math.tau


def end_of(head: Rig, since: float = 0.0, device_id: int = 1) -> float:
    """Where it came to rest, in rad."""
    rest = head.wait_for("at_rest", device_id, since)
    assert rest.position_rad is not None
    return rest.position_rad


def test_S04_a_set_point_that_is_not_renewed_stops_the_joint(head: Rig, robot: AttachedRobot) -> None:
    robot.motor("neck.pan").set_velocity(0.5)
    assert 0.01 < end_of(head) < 0.7
    first, *holds = head.goals(1)[1:]  # the very first is enabling's own
    assert goal_counts(first) >= math.floor(2048 + 1.4 * COUNTS_PER_RAD)
    assert holds
    assert all(goal_counts(hold) < goal_counts(first) for hold in holds)


def test_S04_it_ramps_to_its_stop_at_the_joints_acceleration(rig: Rig) -> None:
    rig.configure(('max_accel_rad_s2 = 20.0\n\n[joint."neck.tilt"]', 'max_accel_rad_s2 = 2.0\n\n[joint."neck.tilt"]'))
    rig.plug()
    pan = rig.attach().motor("neck.pan")
    pan.move_to(-1.4)
    mark = written_now()
    pan.set_velocity(1.0, 1.0)
    wait_until(lambda: rig.goals(1, mark), "it got a goal")
    reported = rig.goals(1, mark)[0]
    rest = rig.wait_for("at_rest", 1, reported.t)
    held = rig.goals(1, reported.t + 1e-6)[0]
    assert rest.t - held.t > 0.8 * 1.0 / 2.0


def test_S04_motion_continues_if_its_set_point_is_renewed_in_time(head: Rig, robot: AttachedRobot) -> None:
    pan = robot.motor("neck.pan")
    pan.move_to(-1.4)
    mark, renewals = written_now(), 0
    while head.truth(1).position_rad < 0.5:
        pan.set_velocity(1.5, 1.0)
        renewals += 1
    assert renewals > 10
    began = head.goals(1, mark)[0].t
    assert len(head.events("motion_started", 1, began)) == 1
    assert not head.events("at_rest", 1, began)
    assert end_of(head, began) <= 1.4 + 0.01


def test_S18_a_servo_that_browns_out_is_sent_no_set_point_after_it_has_booted_limp(
    head: Rig, robot: AttachedRobot
) -> None:
    pan = robot.motor("neck.pan")
    pan.move_to(-1.4)
    head.sim.do(BrownOut(ids=(1,)))
    with suppress(TradeError):
        while True:
            pan.set_velocity(0.5, 1.0)
    booted = head.wait_for("booted", 1)
    wait_until(lambda: "restarted" in pan.state().fault, "it is noticed")
    where = head.truth(1).position_counts
    assert all(abs(goal_counts(entry) - where) <= 1 for entry in head.goals(1, booted.t))  # held blind, at most
    assert not head.truth(1).torque


def test_S04_a_renewal_that_is_refused_renews_nothing(head: Rig, robot: AttachedRobot) -> None:
    pan = robot.motor("neck.pan")
    pan.enable()
    mark = written_now()
    pan.set_velocity(0.3)
    refused = 0
    while not head.events("at_rest", 1, mark):
        with pytest.raises(LimitExceeded):
            pan.set_velocity(3.0)
        refused += 1
    assert refused
    assert head.truth(1).position_rad < 0.7


def test_S04_a_speed_of_zero_stops_at_once(head: Rig, robot: AttachedRobot) -> None:
    pan = robot.motor("neck.pan")
    pan.set_velocity(1.0, 1.0)
    wait_until(lambda: head.truth(1).position_rad > 0.05, "it turns")
    pan.set_velocity(0.0)
    assert end_of(head) < 0.8
    assert pan.resources[0].stops == 0


def test_S04_positions_that_stop_coming_stop_the_whole_group(rig: Rig) -> None:
    rig.configure(
        (
            "max_speed_rad_s = 2.5\nmax_accel_rad_s2 = 20.0\n\n[joint",
            "max_speed_rad_s = 0.5\nmax_accel_rad_s2 = 20.0\n\n[joint",
        )
    )
    rig.plug()
    group = rig.attach().group("head")
    group.servo([1.3, 0.5], 0.3)
    assert 0.01 < end_of(rig, device_id=1) < 0.8


def test_S04_positions_that_keep_coming_are_followed(head: Rig, robot: AttachedRobot) -> None:
    group = robot.group("head")
    for step in range(1, 60):
        group.servo([0.01 * step, -0.005 * step], 1.0)
    wait_until(lambda: abs(head.truth(1).position_rad - 0.59) < 0.01, "it has followed")
    assert head.truth(2).position_rad == pytest.approx(-0.295, abs=0.01)


def test_S08_a_stop_ends_a_set_point_and_what_was_under_way(head: Rig, gate: Gate) -> None:
    pan = head.attach(healthy=gate).motor("neck.pan")
    pan.set_velocity(0.3, 1.0)
    head.wait_for("motion_started", 1)
    gate.hold_up()
    mark = written_now()
    renewal = Outcome(lambda: pan.set_velocity(0.3, 1.0))
    wait_until(lambda: pan._exchange._inbox, "the renewal is admitted")  # type: ignore[attr-defined]
    stop = Outcome(pan.stop)
    wait_until(lambda: pan._exchange._stops, "the stop is admitted")  # type: ignore[attr-defined]
    gate.release()
    stop.wait()
    assert isinstance(renewal.wait().error, MotionStopped)
    assert all(goal_counts(entry) < 2048 + 1.3 * COUNTS_PER_RAD for entry in head.goals(1, mark))


def test_S22_it_brakes_before_the_end_of_the_range(head: Rig, robot: AttachedRobot) -> None:
    robot.motor("neck.pan").set_velocity(2.5, 1.0)
    assert end_of(head) == pytest.approx(1.4, abs=0.01)
    assert max(goal_counts(entry) for entry in head.goals(1)) <= math.ceil(2048 + 1.4 * COUNTS_PER_RAD)


def test_a_reversed_joint_turns_in_the_commanded_direction(head: Rig, robot: AttachedRobot) -> None:
    robot.motor("neck.tilt").set_velocity(0.5)
    assert end_of(head, device_id=2) > 0.01


def test_S22_outwards_from_outside_is_refused_and_inwards_is_not(rig: Rig) -> None:
    rig.plug(Servo(1, position_counts=2048 + 1100), Servo(2))
    pan = rig.attach().motor("neck.pan")
    with pytest.raises(LimitExceeded):
        pan.set_velocity(0.5)
    assert not rig.moves()
    pan.set_velocity(-0.5, 0.5)
    assert end_of(rig) < 1.68


def _velocity(value: float) -> Callable[[Motor], object]:
    return lambda pan: pan.set_velocity(value)


def _valid(seconds: float) -> Callable[[Motor], object]:
    return lambda pan: pan.set_velocity(0.1, seconds)


@pytest.mark.parametrize(
    ("act", "error"),
    [
        (_velocity(2.51), LimitExceeded),
        (_velocity(-2.51), LimitExceeded),
        (_velocity(0.001), LimitExceeded),
        (_velocity(math.nan), InvalidArgument),
        (_velocity(-math.inf), InvalidArgument),
        (_valid(0.0), InvalidArgument),
        (_valid(-0.1), InvalidArgument),
        (_valid(1.01), InvalidArgument),
        (_valid(math.nan), InvalidArgument),
    ],
)
def test_S22_what_is_beyond_the_limits_is_refused_and_nothing_is_sent(
    head: Rig, robot: AttachedRobot, act: Callable[[Motor], object], error: type[Exception]
) -> None:
    with pytest.raises(error):
        act(robot.motor("neck.pan"))
    assert not head.moves()


def test_S22_one_position_outside_refuses_the_whole_group(head: Rig, robot: AttachedRobot) -> None:
    with pytest.raises(LimitExceeded, match=r"rosie\.neck\.tilt"):
        robot.group("head").servo([0.1, 0.7])
    with pytest.raises(InvalidArgument):
        robot.group("head").servo([0.1])
    assert not head.moves()


def test_a_set_point_takes_over_from_a_move_and_a_move_from_a_set_point(head: Rig, robot: AttachedRobot) -> None:
    pan = robot.motor("neck.pan")
    moving = Outcome(lambda: pan.move_to(1.3, 0.2))
    head.wait_for("motion_started", 1)
    pan.set_velocity(-0.5, 1.0)
    assert isinstance(moving.wait().error, MotionStopped)
    assert pan.move_to(0.2) == pytest.approx(0.2, abs=0.03)
