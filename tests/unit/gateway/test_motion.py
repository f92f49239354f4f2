"""Recorded motion as a trajectory: within limits, near to what was recorded, refused where it cannot be known."""

import math
import random
from itertools import pairwise

import pytest

from trade.errors import ConfigurationError, LimitExceeded
from trade_drivers import JointLimits, Tolerances, planned
from trade_gateway.recording._channels import JointStates
from trade_gateway.recording._motion import Motion, Track, deviation, fitted, gaps, motion_of, moving, trajectory

LIMITS = JointLimits(name="rosie.neck.pan", min_rad=-1.4, max_rad=1.4, max_speed_rad_s=2.5, max_accel_rad_s2=20.0)
COUNT_RAD = math.tau / 4096
GENEROUS = Tolerances(goal_time_s=1.0)


def profile(at_s: float, goal: float = 1.2, accel: float = 20.0, speed: float = 2.5) -> float:
    """A servo's own way from 0 to the goal from 0.5 s on: as quick as its limits let it."""
    t = max(0.0, at_s - 0.5)
    ramp = speed / accel
    cruise = goal / speed - ramp
    if t < ramp:
        return accel * t * t / 2
    if t < ramp + cruise:
        return accel * ramp * ramp / 2 + speed * (t - ramp)
    left = max(0.0, 2 * ramp + cruise - t)
    return goal - accel * left * left / 2


def states(
    *, hz: float = 50, seconds: float = 2.0, late_s: float = 0.0, jitter_s: float = 0.0, scale: float = 1.0
) -> list[JointStates]:
    chance = random.Random(1)
    found: list[JointStates] = []
    for number in range(int(seconds * hz)):
        at_s = number / hz + chance.uniform(0, jitter_s)
        position = round(profile(at_s - late_s) * scale / COUNT_RAD) * COUNT_RAD
        found.append(_state(1000.0 + at_s, position))
    return found


def _state(at_s: float, position: float, name: str = "rosie.neck.pan") -> JointStates:
    return JointStates(
        names=[name],
        position_rad=[position],
        velocity_rad_s=[0.0],
        load=[0.0],
        enabled=[True],
        fault=[""],
        stamp_s=[at_s],
    )


@pytest.mark.parametrize(("hz", "jitter_s"), [(50, 0.0), (50, 0.015), (20, 0.02), (200, 0.0)])
def test_a_servo_repeats_on_command_what_it_did_at_its_limits(hz: float, jitter_s: float) -> None:
    motion = motion_of("rosie.head", states(hz=hz, jitter_s=jitter_s))
    way, speed = fitted(motion, 1.0, [LIMITS])
    assert 0.95 <= speed <= 1.0
    [(_, curve)] = planned(way, GENEROUS, [LIMITS]).tracks
    worst = max(abs(curve.at(step / 100 / speed)[0] - motion.tracks[0].at(step / 100)) for step in range(190))
    assert worst < 0.03


def test_half_the_speed_takes_twice_as_long() -> None:
    motion = motion_of("rosie.head", states())
    once, slow = trajectory(motion, 1.0).points, trajectory(motion, 0.5).points
    assert slow[-1].time_from_start_s == pytest.approx(2 * once[-1].time_from_start_s)
    assert [point.positions_rad for point in slow] == [point.positions_rad for point in once]
    assert once[12].velocities_rad_s is not None
    assert slow[12].velocities_rad_s == [velocity / 2 for velocity in once[12].velocities_rad_s]


def test_rest_at_both_ends_of_a_motion_is_cut_to_half_a_second() -> None:
    whole = motion_of("rosie.head", states(seconds=60, late_s=40))
    part = moving(whole)
    once = moving(motion_of("rosie.head", states(seconds=4)))
    assert part.duration_s == pytest.approx(once.duration_s, abs=0.03)
    assert part.duration_s < 2.5
    assert (part.start, part.tracks[0].at(9)) == ([0.0], whole.tracks[0].positions_rad[-1])
    assert max(abs(part.tracks[0].at(t / 100) - once.tracks[0].at(t / 100)) for t in range(200)) < 0.05


def test_a_joint_that_was_not_measured_while_the_others_moved_stays_where_it_was() -> None:
    motion = Motion("rosie.head", ["pan", "tilt"], [Track([0, 5, 5.5, 10], [0, 0, 1, 1]), Track([0, 10], [0.3, 0.3])])
    part = moving(motion)
    assert [track.positions_rad[0] for track in part.tracks] == [0, 0.3]
    assert [track.positions_rad[-1] for track in part.tracks] == [1, 0.3]
    assert part.duration_s == pytest.approx(1.5, abs=0.03)


def test_a_joint_that_never_moved_stays_unchanged() -> None:
    motion = motion_of("rosie.head", states(scale=0.01))
    assert moving(motion) == motion


@pytest.mark.parametrize("shift_s", [0.0, 0.01, 0.02, 0.03])
def test_what_came_to_rest_at_the_end_of_its_range_swings_nowhere_beyond_it(shift_s: float) -> None:
    """Between the points, too: from 1.2 rad down to the end of the range at 0, and back up."""
    limits = JointLimits(name="rosie.neck.pan", min_rad=0.0, max_rad=1.2, max_speed_rad_s=2.5, max_accel_rad_s2=20.0)
    down = [(at / 50, 1.2 - profile(at / 50 - shift_s)) for at in range(100)]
    up = [(2 + at / 50, profile(at / 50 - shift_s)) for at in range(100)]
    motion = motion_of("rosie.head", [_state(1000.0 + at_s, position) for at_s, position in (*down, *up)])
    way, _ = fitted(motion, 1.0, [limits])
    assert min(point.positions_rad[0] for point in way.points) < 0.01
    planned(way, GENEROUS, [limits])  # raises LimitExceeded otherwise


def test_what_is_beyond_a_limit_is_refused() -> None:
    motion = motion_of("rosie.head", states(scale=1.5))
    with pytest.raises(LimitExceeded, match="angle"):
        fitted(motion, 1.0, [LIMITS])
    with pytest.raises(LimitExceeded, match=r"speed .* \(with --speed (0.9|1.0)\d it keeps the limits\)"):
        fitted(motion_of("rosie.head", states()), 1.5, [LIMITS])


def test_what_rested_at_the_end_of_its_range_may_go_there_again() -> None:
    motion = motion_of("rosie.head", [_state(at_s / 10, 1.402) for at_s in range(20)])
    way, _ = fitted(motion, 1.0, [LIMITS])
    assert {position for point in way.points for position in point.positions_rad} == {1.398}


def test_a_measurement_that_was_read_twice_counts_once() -> None:
    motion = motion_of("rosie.head", [_state(1.0, 0.1), _state(1.0005, 0.1), _state(1.02, 0.2), _state(1.04, 0.3)])
    assert motion.tracks[0].positions_rad == [0.1, 0.2, 0.3]
    assert all(after > before for before, after in pairwise(motion.tracks[0].times_s))


def test_a_gap_in_which_a_joint_moved_is_refused_and_one_in_which_it_rested_is_no_gap() -> None:
    whole = states(seconds=4)
    moved = [state for number, state in enumerate(whole) if not 20 < number < 60]
    with pytest.raises(ConfigurationError, match=r"rosie.neck.pan was not measured from 0.4 to 1.2 s, while it moved"):
        motion_of("rosie.head", moved)
    stood = [state for number, state in enumerate(whole) if not 110 < number < 190]
    fitted(motion_of("rosie.head", stood), 1.0, [LIMITS])


@pytest.mark.parametrize(("moved_m", "count"), [(0.01, 1), (0.001, 0)])
def test_a_gripper_that_moved_unmeasured_has_a_gap_in_m(moved_m: float, count: int) -> None:
    before, after = (_width(at_s, width_m) for at_s, width_m in ((1.0, 0.05), (1.6, 0.05 - moved_m)))
    assert len(gaps("rosie.left.hand", [before, after])) == count


def _width(at_s: float, width_m: float) -> JointStates:
    return JointStates(
        names=["rosie.left.hand"],
        position_rad=[],
        velocity_rad_s=[],
        width_m=[width_m],
        speed_m_s=[0.0],
        load=[],
        enabled=[True],
        fault=[""],
        stamp_s=[at_s],
    )


def test_joints_must_be_the_same_all_through_and_measured() -> None:
    with pytest.raises(ConfigurationError, match=r"other joints later: rosie.neck.tilt instead of rosie.neck.pan"):
        motion_of("rosie.head", [_state(1, 0), _state(2, 0, "rosie.neck.tilt")])
    with pytest.raises(ConfigurationError, match="fewer than three measurements"):
        motion_of("rosie.head", [_state(1, 0), _state(2, 0)])


@pytest.mark.parametrize("late_s", [0.0, 0.31, 1.4])
def test_motions_are_compared_at_the_delay_at_which_they_fit(late_s: float) -> None:
    motion = motion_of("rosie.head", states())
    found, delay_s = deviation(motion, 1.0, motion_of("rosie.head", states(late_s=late_s, seconds=4)))
    assert delay_s == pytest.approx(late_s, abs=0.01)
    assert found.greatest_rad[0] < 0.02


def test_a_different_motion_is_detected() -> None:
    motion = motion_of("rosie.head", states())
    found, _ = deviation(motion, 1.0, motion_of("rosie.head", states(scale=0.9, seconds=4)))
    assert found.greatest_rad[0] == pytest.approx(0.12, abs=0.01)
    assert 0.05 < found.rms_rad[0] < 0.12


def test_joints_are_compared_by_name() -> None:
    still, moved = Track([0.0, 1.0], [0.0, 0.0]), Track([0.0, 1.0], [0.0, 1.0])
    motion = Motion("g", ["a", "b"], [still, moved])
    found, _ = deviation(motion, 1.0, Motion("g", ["b", "a"], [moved, still]))
    assert list(found.greatest_rad) == [0.0, 0.0]
