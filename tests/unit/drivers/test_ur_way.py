"""Arithmetic of the driver of arms: poses on a line, and the age of what carries the time of another clock."""

from math import pi

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trade_drivers.vendors.ur._path import poses_on
from trade_drivers.vendors.ur._states_child import Age
from trade_hil_sim.ur._kinematics import pose_between, way_of

POSES = st.tuples(*(st.floats(-0.5, 0.5) for _ in range(3)), *(st.floats(-1.5, 1.5) for _ in range(3)))


@given(POSES, POSES)
@settings(max_examples=60, deadline=None)
def test_poses_lie_on_the_line_close_together_and_end_at_the_goal(
    start: tuple[float, ...], goal: tuple[float, ...]
) -> None:
    poses = poses_on(start, goal)
    assert poses[-1] == list(goal)
    before = list(start)
    for k, pose in enumerate(poses, 1):
        metres, turn = way_of(pose_between(start, goal, k / len(poses)), pose)
        assert (metres, turn) == pytest.approx((0.0, 0.0), abs=1e-6)
        metres, turn = way_of(before, pose)
        assert metres <= 0.0501
        assert turn <= 0.201
        before = pose


def test_half_a_turn_is_made_in_steps() -> None:
    poses = poses_on([0.0] * 6, [0.0, 0.0, 0.0, 0.0, 0.0, pi])
    assert [pose[5] for pose in poses] == pytest.approx([pi * k / len(poses) for k in range(1, len(poses) + 1)])


def test_late_data_has_its_true_age() -> None:
    age = Age()
    for k in range(100):
        assert age.measured_ns(10**9 + k * 2_000_000, k * 2_000_000) == pytest.approx(10**9 + k * 2_000_000, abs=2_000)
    at_ns = 10**9 + 100 * 2_000_000 + 10**9  # a second late
    assert at_ns - age.measured_ns(at_ns, 100 * 2_000_000) == pytest.approx(10**9, rel=0.01)


def test_clocks_that_differ_a_little_make_nothing_old() -> None:
    age, oldest_ns = Age(), 0
    for k in range(10_000):
        at_ns, stamp_ns = k * 10_000_000, int(k * 10_000_000 * 0.9998)
        oldest_ns = max(oldest_ns, at_ns - age.measured_ns(at_ns, stamp_ns))
    assert oldest_ns < 10_000
