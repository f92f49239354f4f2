"""Profiles of speed that keep the limits of a joint are accepted at every sampling, and others are refused."""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import msgspec
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from trade.errors import InvalidArgument, LimitExceeded, TradeError
from trade_drivers import JointLimits, Tolerances, Trajectory, TrajectoryPoint, planned
from trade_drivers.motion._plan import Plan

SPEED, ACCEL = 2.0, 10.0
SAMPLING_S = st.floats(0.004, 0.1)
"""At most as long as the ramps that are refused, so that a whole step is inside of them."""
properties = settings(deadline=None, max_examples=40)


class Profile(NamedTuple):
    """Phases of constant acceleration from rest at 0 rad; each is a duration in s and an acceleration in rad/s2."""

    phases: Sequence[tuple[float, float]]

    @property
    def duration_s(self) -> float:
        return sum(duration for duration, _ in self.phases)

    @property
    def fastest_rad_s(self) -> float:
        ends_s = [sum(duration for duration, _ in self.phases[:count]) for count in range(len(self.phases) + 1)]
        return max(abs(self.at(end_s)[1]) for end_s in ends_s)

    def at(self, time_s: float) -> tuple[float, float]:
        position = speed = 0.0
        for duration, accel in self.phases:
            for_s = max(0.0, min(duration, time_s))
            position, speed = position + speed * for_s + accel * for_s**2 / 2, speed + accel * for_s
            time_s -= for_s
        return position, speed

    def range_rad(self) -> tuple[float, float]:
        """The exact ends: those of its phases, and where it turns back."""
        times, began = [0.0], 0.0
        for duration, accel in self.phases:
            turn = -self.at(began)[1] / accel if accel else 0.0
            times += [began + turn] if 0 < turn < duration else []
            began += duration
            times.append(began)
        angles = [self.at(time_s)[0] for time_s in times]
        return min(angles), max(angles)

    def sampled(self, every_s: float, digits: int = 17) -> Trajectory:
        """The point at each sampling, and the last one at rest; with 9 digits, as in messages of ROS."""
        count = math.ceil(self.duration_s / every_s - 1e-9)
        points = [
            TrajectoryPoint(
                time_from_start_s=round(at, digits),
                positions_rad=[round(self.at(at)[0], digits)],
                velocities_rad_s=[round(self.at(at)[1], digits) if at < self.duration_s else 0.0],
            )
            for at in [*(every_s * number for number in range(count)), self.duration_s]
        ]
        return Trajectory(joints=["rosie.joint"], points=points)


def shape(accel: float) -> Profile:
    """A ramp to 2 rad/s, a cruise, and a ramp to rest."""
    return Profile([(SPEED / accel, accel), (0.25, 0.0), (SPEED / accel, -accel)])


@st.composite
def profiles(draw: st.DrawFn, least_s: float = 0.0) -> Profile:
    """Within the limits: up to six changes of speed, each followed by a cruise, and a ramp to rest."""
    speed, phases = 0.0, list[tuple[float, float]]()
    for goal in [*draw(st.lists(st.floats(-SPEED, SPEED), min_size=1, max_size=6)), 0.0]:
        accel = math.copysign(ACCEL * (draw(st.just(1.0) | st.floats(0.1, 1))), goal - speed)
        if abs(goal - speed) > 1e-3:
            phases.append(((goal - speed) / accel, accel))
            speed = goal
        phases.append((least_s + draw(st.sampled_from([0.0, 0.3]) | st.floats(0, 0.3)), 0.0))
    return Profile([phase for phase in [*phases, (0.1, 0.0)] if phase[0] > 1e-9])


def plan(trajectory: Trajectory, low: float = -99.0, high: float = 99.0) -> Plan:
    limits = JointLimits(name="rosie.joint", min_rad=low, max_rad=high, max_speed_rad_s=SPEED, max_accel_rad_s2=ACCEL)
    return planned(trajectory, Tolerances(), [limits])


def judge(made: Plan, trajectory: Trajectory, low: float, high: float) -> None:
    """The motion passes each point at its speed, and keeps the limits at each moment, by its angles alone."""
    [(_, curve)] = made.tracks
    for point in trajectory.points[:-1]:
        assert point.velocities_rad_s
        wanted = (point.positions_rad[0], point.velocities_rad_s[0])
        assert curve.at(point.time_from_start_s) == pytest.approx(wanted, abs=1e-5)
    assert curve.at(math.inf)[0] == pytest.approx(trajectory.points[-1].positions_rad[0], abs=1e-5)
    step = 2e-3
    angles = [curve.at(step * number)[0] for number in range(-2, int(curve.duration_s / step) + 3)]
    speeds = [(after - before) / step for before, after in pairwise(angles)]
    assert low - 1e-5 <= min(angles) <= max(angles) <= high + 1e-5
    assert max(map(abs, speeds)) <= SPEED + 1e-5
    assert max(abs(after - before) / step for before, after in pairwise(speeds)) <= ACCEL + 0.01  # a nanosecond's


FIELD = [(0, 0, 0), (0.1, 0.05, 1), (0.2, 0.2, 2), (0.3, 0.4, 2), (0.4, 0.6, 2), (0.5, 0.7875, 1.5), (0.6, 0.8875, 0.5)]


def rows(*given: tuple[float, float, float]) -> Trajectory:
    """Times, angles and speeds."""
    points = [TrajectoryPoint(time_from_start_s=t, positions_rad=[p], velocities_rad_s=[v]) for t, p, v in given]
    return Trajectory(joints=["rosie.joint"], points=points)


def test_S22_the_trapezoid_from_the_field_is_accepted_and_followed_within_the_limits() -> None:
    trajectory = rows(*FIELD, (0.65, 0.9, 0))
    made = plan(trajectory, 0.0, 0.9)
    judge(made, trajectory, 0.0, 0.9)
    assert made.tracks[0].curve.at(0.45) == pytest.approx((0.7, 2.0))  # it brakes where the profile does


@properties
@given(profiles(), SAMPLING_S, st.sampled_from([17, 9]))
def test_S22_a_profile_within_the_limits_is_accepted_at_every_sampling(
    profile: Profile, every_s: float, digits: int
) -> None:
    trajectory, ends = profile.sampled(every_s, digits), profile.range_rad()
    judge(plan(trajectory, *ends), trajectory, *ends)


@properties
@given(st.sampled_from([11.0, 13.0]) | st.floats(10.1, 20.0), SAMPLING_S)
def test_S22_a_ramp_beyond_the_acceleration_is_refused_at_every_sampling(accel: float, every_s: float) -> None:
    with pytest.raises(LimitExceeded, match=r"rosie\.joint acceleration from .* s on") as refused:
        plan(shape(accel).sampled(every_s))
    assert ACCEL < abs(refused.value.value) <= accel * (1 + 1e-3)
    assert (refused.value.lower, refused.value.upper, refused.value.unit) == (-ACCEL, ACCEL, "rad/s2")


@properties
@given(profiles(least_s=0.1), st.floats(1.01, 3.0), SAMPLING_S)
def test_S22_a_cruise_beyond_the_speed_is_refused_at_every_sampling(
    profile: Profile, factor: float, every_s: float
) -> None:
    assume(profile.fastest_rad_s > 0.1)
    stretch = SPEED * factor / profile.fastest_rad_s
    faster = Profile([(duration * (stretch if accel else 1), accel) for duration, accel in profile.phases])
    with pytest.raises(LimitExceeded, match=r"rosie\.joint speed from .* s on"):
        plan(faster.sampled(every_s))


@properties
@given(profiles(least_s=0.1), SAMPLING_S)
def test_S22_a_rest_beyond_the_range_is_refused_at_every_sampling(profile: Profile, every_s: float) -> None:
    low, high = profile.range_rad()
    end = profile.at(profile.duration_s)[0]
    assume(abs(end) > 1e-3)
    inner = (low, end - 1e-3) if end > 0 else (end + 1e-3, high)
    with pytest.raises(LimitExceeded, match=r"rosie\.joint angle from .* s on"):
        plan(profile.sampled(every_s), *inner)


@pytest.mark.parametrize(("way_rad", "needs_rad_s2"), [(0.074, 0.0), (0.08, 12.0), (0.026, 0.0), (0.02, -12.0)])
def test_S22_a_piece_is_possible_between_full_braking_and_full_acceleration(
    way_rad: float, needs_rad_s2: float
) -> None:
    """From 0.5 rad/s to the same in 0.1 s: at 10 rad/s2, 0.05 rad and up to 0.025 more or less."""
    end = 0.025 + way_rad
    trajectory = rows((0.0, 0.0, 0.0), (0.1, 0.025, 0.5), (0.2, end, 0.5), (0.3, end + 0.025, 0.0))
    if not needs_rad_s2:
        judge(plan(trajectory), trajectory, -9, 9)
        return
    with pytest.raises(LimitExceeded, match=r"acceleration from 0\.1 s on") as refused:
        plan(trajectory)
    assert refused.value.value == pytest.approx(needs_rad_s2, rel=1e-3)


def test_S22_within_a_piece_the_range_is_left_no_farther_than_braking_needs() -> None:
    """From 1 rad/s to rest at the end of the range, in twice the time: the cubic curve would leave the range."""
    trajectory = rows((0.0, 0.0, 0.0), (0.2, 0.1, 1.0), (0.6, 0.15, 0.0))
    judge(plan(trajectory, 0.0, 0.15), trajectory, 0.0, 0.15)
    with pytest.raises(LimitExceeded, match=r"angle from 0\.2 s on") as refused:
        plan(rows((0.0, 0.0, 0.0), (0.2, 0.1, 1.0), (0.6, 0.14, 0.0)), 0.0, 0.14)
    assert 0.14 < refused.value.value <= 0.15 + 1e-9


@pytest.mark.parametrize("speed", [1e-12, -4e-7, 5e-5, 1e-3])
def test_a_last_speed_that_no_joint_resolves_is_rest(speed: float) -> None:
    made = plan(rows((0.0, 0.0, 0.0), (1.0, 0.5, speed)))
    assert made.tracks[0].curve.at(1.0) == (pytest.approx(0.5), 0.0)


@pytest.mark.parametrize("speed", [0.05, -0.05, 2e-3])
def test_S22_a_last_speed_is_refused_with_its_joint_and_its_size(speed: float) -> None:
    with pytest.raises(InvalidArgument, match=rf"rosie\.joint still has {speed:g} rad/s .* must end at rest"):
        plan(rows((0.0, 0.0, 0.0), (1.0, 0.5, speed)))


def test_a_ramp_that_is_cut_off_just_before_its_end_is_no_faster_for_it() -> None:
    ends_s = 0.2 - 5e-5
    profile = Profile([(0.2, ACCEL), (0.2, -ACCEL)])
    trajectory = rows(*((at, *profile.at(at)) for at in (0.0, 0.1, 0.2, 0.3, 0.2 + ends_s)))
    judge(plan(trajectory), trajectory, 0.0, 0.4)


@pytest.mark.parametrize("first_s", [1e-12, -1e-12, 1e-9, 9e-4])
def test_a_first_time_that_is_almost_0_is_0(first_s: float) -> None:
    [(_, curve)] = plan(rows((first_s, 0.0, 0.0), (1.0 + first_s, 0.5, 0.0))).tracks
    assert (curve.at(0), curve.duration_s) == ((0.0, 0.0), pytest.approx(1.0))


@pytest.mark.parametrize("first_s", [1e-3, 0.05, -0.05])
def test_S22_a_first_time_is_refused_with_its_size(first_s: float) -> None:
    with pytest.raises(InvalidArgument, match=rf"the first is {first_s:g}; it must be 0"):
        plan(rows((first_s, 0.0, 0.0), (1.0, 0.5, 0.0)))


@pytest.mark.parametrize("step_s", [0.0, 1e-200, 1e-12, -1.0])
def test_S22_points_at_one_time_are_refused(step_s: float) -> None:
    with pytest.raises(InvalidArgument, match="times must increase, by 1 ns at least"):
        plan(rows((0.0, 0.0, 0.0), (step_s, 0.0, 0.0), (1.0, 0.0, 0.0)))


def test_points_a_nanosecond_apart_are_accepted() -> None:
    plan(rows((0.0, 0.0, 0.0), (5.0, 0.0, 0.0), (5.000000001, 0.0, 0.0), (6.0, 0.0, 0.0)))


@pytest.mark.parametrize("accel", [10.0, -10.0])
def test_accelerations_of_points_are_accepted_within_the_limits(accel: float) -> None:
    with_it = msgspec.structs.replace(rows((0.0, 0.0, 0.0), (1.0, 0.5, 0.0)).points[1], accelerations_rad_s2=[accel])
    plan(Trajectory(joints=["rosie.joint"], points=[rows((0.0, 0.0, 0.0)).points[0], with_it]))


@pytest.mark.parametrize(
    ("accels", "error", "says"),
    [
        ([10.1], LimitExceeded, r"rosie\.joint acceleration from 1 s on: 10\.1 rad/s2 is outside -10 to 10"),
        ([math.nan], InvalidArgument, r"accelerations_rad_s2.*finite"),
        ([1.0, 2.0], InvalidArgument, r"accelerations_rad_s2.*takes 1"),
    ],
)
def test_S22_accelerations_of_points_keep_the_limits(accels: list[float], error: type[TradeError], says: str) -> None:
    with_it = msgspec.structs.replace(rows((0.0, 0.0, 0.0), (1.0, 0.5, 0.0)).points[1], accelerations_rad_s2=accels)
    with pytest.raises(error, match=says):
        plan(Trajectory(joints=["rosie.joint"], points=[rows((0.0, 0.0, 0.0)).points[0], with_it]))
