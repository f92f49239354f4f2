"""Curves between points, against what can be worked out by hand or by sampling finely."""

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trade_drivers.motion._spline import Curve, JointTask, there_together

ANGLES = st.floats(-3, 3)
STEPS = st.floats(0.05, 2)
WAYS = st.builds(
    JointTask,
    start_rad=ANGLES,
    velocity_rad_s=st.just(0.0) | st.floats(-2, 2),
    goal_rad=ANGLES,
    speed_rad_s=st.floats(0.1, 3),
    accel_rad_s2=st.floats(0.5, 20),
)


@st.composite
def points(draw: st.DrawFn) -> tuple[list[float], list[float], list[float]]:
    steps = draw(st.lists(STEPS, min_size=1, max_size=6))
    times = [sum(steps[:count]) for count in range(len(steps) + 1)]
    many = st.lists(ANGLES, min_size=len(times), max_size=len(times))
    return times, draw(many), draw(many)


def fine(curve: Curve) -> list[float]:
    return [curve.duration_s * step / 1000 for step in range(1001)]


@given(points())
def test_it_goes_through_its_points_at_the_speeds_given(given: tuple[list[float], list[float], list[float]]) -> None:
    times, positions, velocities = given
    curve = Curve.through(times, positions, velocities)
    for time_s, position, velocity in list(zip(*given, strict=True))[:-1]:
        assert curve.at(time_s) == pytest.approx((position, velocity), abs=1e-6)
    assert curve.at(curve.duration_s) == pytest.approx((positions[-1], 0.0), abs=1e-6)
    assert curve.at(-1) == curve.at(0)


@given(points())
def test_the_reported_extremes_are_those_of_the_curve(given: tuple[list[float], list[float], list[float]]) -> None:
    curve = Curve.through(*given)
    samples = [curve.at(time_s) for time_s in fine(curve)[:-1]]
    for which, reported in (
        (0, [angle for piece in curve.pieces for angle in piece.angles()]),
        (1, [speed for piece in curve.pieces for speed in piece.speeds()]),
    ):
        seen = [sample[which] for sample in samples]
        near = 0.02 * (max(seen) - min(seen)) + 1e-6
        assert max(reported) >= max(seen) - 1e-6
        assert min(reported) <= min(seen) + 1e-6
        assert max(reported) <= max(seen) + near + 0.5 * which * _steepest(curve) * curve.duration_s / 1000 + near
    accels = [accel for piece in curve.pieces for accel in piece.accels()]
    rises = [(after - before) / (curve.duration_s / 1000) for (_, before), (_, after) in pairwise(samples)]
    assert max(map(abs, rises)) <= max(map(abs, accels)) + 1e-6


def _steepest(curve: Curve) -> float:
    return max(abs(accel) for piece in curve.pieces for accel in piece.accels())


@given(points())
def test_without_speeds_it_overshoots_no_point_and_is_at_rest_at_both_ends(
    given: tuple[list[float], list[float], list[float]],
) -> None:
    times, positions, _ = given
    curve = Curve.through(times, positions)
    for piece, (start, end) in zip(curve.pieces, pairwise(positions), strict=True):
        assert max(piece.angles()) <= max(start, end) + 1e-9
        assert min(piece.angles()) >= min(start, end) - 1e-9
    assert curve.at(0)[1] == curve.at(curve.duration_s)[1] == 0


def test_two_points_at_rest_give_the_standard_cubic() -> None:
    curve = Curve.through([0, 2], [0, 1])
    assert curve.at(1) == pytest.approx((0.5, 0.75))  # one and a half times the mean speed
    assert curve.pieces[0].accels() == pytest.approx((1.5, -1.5))  # six times the distance by the time squared


@given(st.lists(WAYS, min_size=1, max_size=4))
def test_joints_that_go_together_arrive_together_within_their_limits(ways: list[JointTask]) -> None:
    curves = there_together(ways)
    assert len({round(curve.duration_s, 6) for curve in curves}) == 1
    for way, curve in zip(ways, curves, strict=True):
        assert curve.at(0) == pytest.approx((way.start_rad, way.velocity_rad_s), abs=0.02)
        assert curve.at(math.inf) == pytest.approx((way.goal_rad, 0), abs=1e-6)
        allowed = max(way.speed_rad_s, abs(way.velocity_rad_s))
        assert max(abs(speed) for piece in curve.pieces for speed in piece.speeds()) <= allowed * (1 + 1e-6) + 1e-6
        accels = [abs(accel) for piece in curve.pieces for accel in piece.accels()]
        assert max(accels) <= way.accel_rad_s2 * (1 + 1e-6) + 1e-5


def test_the_slowest_joint_goes_at_its_limits() -> None:
    slow, fast = there_together([JointTask(0, 0, 2, 1, 4), JointTask(0, 0, 0.1, 1, 4)])
    assert slow.duration_s == pytest.approx(2 / 1 + 1 / 4)  # at speed for all of it but the two ramps
    assert fast.duration_s == slow.duration_s
    [short] = there_together([JointTask(0, 0, 1, 10, 4)])
    assert short.duration_s == pytest.approx(2 * math.sqrt(1 / 4))  # never gets to its speed
