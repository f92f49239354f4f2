"""The motion model: trapezoids that arrive, within their limits, whatever they begin with."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trade_hil_sim.mechanics._profile import Course, at_rest, to_position, to_speed

pytestmark = pytest.mark.virtual_time

POSITIONS = st.floats(-1e6, 1e6)
SPEEDS = st.floats(-5000, 5000)
TOPS = st.floats(1, 5000)
RATES = st.floats(100, 1e5)


def sampled(course: Course, n: int = 200) -> list[tuple[float, float, float, float]]:
    span = course.ends - course.begins
    times = [course.begins + span * k / n for k in range(n + 1)]
    return [(t, *course.at(t)) for t in times]


@given(POSITIONS, SPEEDS, POSITIONS, TOPS, RATES)
def test_it_ends_at_the_goal_at_rest(position: float, speed: float, goal: float, top: float, rate: float) -> None:
    course = to_position(5.0, position, speed, goal, top, rate)
    assert course.at(course.ends + 1) == (goal, 0.0, 0.0)
    # the last stretch leads there by itself; the goal is not jumped to
    before, _, _ = course.at(course.begins + (course.ends - course.begins) * (1 - 1e-9))
    assert before == pytest.approx(goal, abs=1e-2 + 1e-6 * abs(goal - position))


@given(POSITIONS, SPEEDS, POSITIONS, TOPS, RATES)
def test_it_keeps_to_speed_and_acceleration(
    position: float, speed: float, goal: float, top: float, rate: float
) -> None:
    course = to_position(0.0, position, speed, goal, top, rate)
    limit = max(top, abs(speed))
    for (t0, _, v0, a0), (t1, _, v1, _) in pairwise(sampled(course)):
        assert abs(v0) <= limit * (1 + 1e-6) + 1e-6
        assert abs(a0) <= rate * (1 + 1e-9)
        assert abs(v1 - v0) <= rate * (t1 - t0) * (1 + 1e-6) + 1e-3 * limit + 1e-3


def test_a_long_way_is_a_trapezoid() -> None:
    course = to_position(0.0, 0.0, 0.0, 1000.0, 200.0, 400.0)
    # 0.5 s up, 4.5 s along, 0.5 s down
    assert course.ends == pytest.approx(5.5)
    assert course.at(0.25) == pytest.approx((12.5, 100.0, 400.0))
    assert course.at(2.0) == pytest.approx((350.0, 200.0, 0.0))
    assert course.at(5.25) == pytest.approx((987.5, 100.0, -400.0))


def test_a_short_way_is_a_triangle() -> None:
    course = to_position(0.0, 0.0, 0.0, -100.0, 1000.0, 400.0)
    assert course.ends == pytest.approx(1.0)
    assert course.at(0.5)[:2] == pytest.approx((-50.0, -200.0))


def test_a_goal_behind_is_reached_by_braking_and_coming_back() -> None:
    course = to_position(0.0, 0.0, 200.0, 0.0, 200.0, 400.0)
    farthest = max(position for _, position, _, _ in sampled(course))
    assert farthest == pytest.approx(50.0, rel=1e-3)
    assert course.at(course.ends) == (0.0, 0.0, 0.0)


def test_a_speed_is_reached_at_the_given_rate_and_kept() -> None:
    course = to_speed(1.0, 10.0, 0.0, -100.0, 50.0)
    assert course.at(2.0) == pytest.approx((-15.0, -50.0, -50.0))
    assert course.at(4.0) == pytest.approx((-190.0, -100.0, 0.0))
    assert course.final_speed == pytest.approx(-100.0)


def test_at_rest_nothing_changes() -> None:
    assert at_rest(0.0, 7.0).at(1e6) == (7.0, 0.0, 0.0)
    assert to_position(0.0, 7.0, 0.0, 7.0, 100.0, 100.0).ends == 0.0
