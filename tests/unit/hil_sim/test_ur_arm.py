"""The simulated arm by itself: kinematics, ways, braking. Time passes when the test says so."""

from itertools import pairwise
from math import pi

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trade_hil_sim import Arm, SimulationError
from trade_hil_sim.ur import HOME, MODELS
from trade_hil_sim.ur._kinematics import flange, joints_for, pose_between, pose_of, way_of
from trade_hil_sim.ur._motions import MAX_SPEED_RAD_S

STEP_S = 0.002
ANGLES = st.tuples(*(st.floats(-1.0, 1.0) for _ in range(6)))


def let_pass(arm: Arm, seconds: float) -> list[tuple[float, ...]]:
    """The angles after each step."""
    seen: list[tuple[float, ...]] = []
    for _ in range(round(seconds / STEP_S)):
        arm.advance(STEP_S)
        seen.append(arm.q)
    return seen


def test_stretched_out_an_arm_is_as_long_as_the_data_sheet_says() -> None:
    # UR5e: 0.425 + 0.3922 m of links, the wrist 0.0997 below, 0.1333 + 0.0996 to the side, the base 0.1625 high
    x, y, z, *_ = pose_of(flange(MODELS["UR5e"], (0.0,) * 6))
    assert (x, y, z) == pytest.approx((-0.8172, -0.2329, 0.1625 - 0.0997))


@given(ANGLES)
@settings(max_examples=50, deadline=None)
def test_the_joint_angles_found_for_a_pose_lead_to_it(offsets: tuple[float, ...]) -> None:
    model = MODELS["UR10e"]
    near = tuple(a + 0.3 * b for a, b in zip(HOME, offsets, strict=True))
    pose = pose_of(flange(model, near))
    found = joints_for(model, pose, HOME)
    assert found is not None
    metres, turn = way_of(pose_of(flange(model, found)), pose)
    assert metres < 1e-6
    assert turn < 1e-6


def test_what_is_out_of_reach_has_no_joint_angles() -> None:
    assert joints_for(MODELS["UR3e"], (2.0, 0.0, 0.0, 0.0, 0.0, 0.0), HOME) is None


def test_half_way_between_two_poses_is_as_far_from_both() -> None:
    one, other = (0.1, 0.2, 0.3, 0.0, pi, 0.0), (0.2, 0.0, 0.3, 0.0, pi, 0.5)
    middle = pose_between(one, other, 0.5)
    assert way_of(one, middle) == pytest.approx(way_of(middle, other))


def test_a_move_keeps_its_speed_and_ends_at_its_goal() -> None:
    arm = Arm()
    goal = (HOME[0] + 0.5, HOME[1] + 0.2, *HOME[2:])
    assert arm.move_joints(goal, 0.5, 2.0)
    seen = let_pass(arm, 2.0)
    fastest = max(abs(b[0] - a[0]) / STEP_S for a, b in pairwise(seen))
    assert 0.49 < fastest < 0.501
    assert seen[-1] == pytest.approx(goal)
    assert not arm.moving


def test_along_a_line_the_flange_keeps_to_it() -> None:
    arm = Arm()
    start = arm.pose()
    goal = (start[0], start[1], start[2] - 0.2, *start[3:])
    assert arm.move_line(goal, 0.5, 1.0)
    for q in let_pass(arm, 1.5):
        x, y, *_ = arm.pose(q)
        assert (x, y) == pytest.approx(start[:2], abs=1e-3)
    assert arm.pose() == pytest.approx(goal, abs=1e-6)


def test_half_the_speed_takes_twice_as_long() -> None:
    ways: list[float] = []
    for fraction in (1.0, 0.5):
        arm = Arm()
        arm.speed_fraction = fraction
        arm.turn((0.0,) * 5 + (0.5,), 1000.0, 0.0)
        ways.append(let_pass(arm, 1.0)[-1][5] - HOME[5])
    assert ways[1] / ways[0] == pytest.approx(0.5, rel=0.01)


def test_braking_ends_a_motion_and_a_target_that_jumps_is_followed_within_the_limits() -> None:
    arm = Arm()
    arm.servo((HOME[0] + 1.0, *HOME[1:]))
    seen = let_pass(arm, 0.2)
    assert max(abs(b[0] - a[0]) / STEP_S for a, b in pairwise(seen)) < MAX_SPEED_RAD_S * 1.001
    arm.halt(8.0)
    let_pass(arm, 1.0)
    assert not arm.moving
    assert seen[-1][0] < arm.q[0] < seen[-1][0] + MAX_SPEED_RAD_S**2 / 8.0


def test_a_target_that_jumps_is_reached_without_going_beyond_it() -> None:
    arm = Arm()
    target = (HOME[0] + 0.05, *HOME[1:])
    arm.servo(target)
    seen = let_pass(arm, 1.0)
    assert max(q[0] for q in seen) <= target[0] + 40.0 * STEP_S**2
    assert seen[-1] == target


def test_a_joint_at_its_limit_is_a_protective_stop() -> None:
    arm = Arm(q=(6.2, *HOME[1:]))
    arm.turn((1.0, *(0.0,) * 5), 10.0, 0.0)
    let_pass(arm, 1.0)
    assert arm.safety_mode.name == "PROTECTIVE_STOP"
    assert arm.q[0] <= 2 * pi
    assert not arm.moving


def test_without_power_nothing_moves() -> None:
    arm = Arm(running=False)
    assert not arm.move_joints((0.0,) * 6, 1.0, 1.0)
    let_pass(arm, 0.1)
    assert arm.q == HOME


def test_a_speed_slider_at_zero_holds_a_move_up_until_it_is_raised() -> None:
    arm = Arm()
    arm.move_joints((0.5, *HOME[1:]), 1.0, 2.0)
    let_pass(arm, 0.2)
    arm.speed_fraction, at = 0.0, arm.q
    let_pass(arm, 1.0)
    assert (arm.q, arm.speeds, arm.moving) == (at, (0.0,) * 6, False)
    arm.speed_fraction = 1.0
    let_pass(arm, 2.0)
    assert arm.q[0] == pytest.approx(0.5)


def test_an_unknown_model_is_refused() -> None:
    with pytest.raises(SimulationError, match="UR5e"):
        Arm("PUMA")
