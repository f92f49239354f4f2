"""The contract of Arm, for drivers of all vendors."""

# ruff: noqa: S101 - these are tests

import math
import threading
from collections.abc import Sequence
from typing import Final

from trade.errors import InvalidArgument, LimitExceeded, MotionStopped, ToleranceExceeded
from trade_drivers.interfaces._arm import Arm
from trade_drivers.interfaces._trajectory import Trajectory, TrajectoryPoint
from trade_drivers.testing._asking import NEAR_RAD, REACH_RAD, SPEED_RAD_S, Caller, refused, until

_NEAR_M: Final = 0.002
_LINE_M: Final = 0.02


class ArmContract:
    """Subclass it with a fixture ``arm``: attached, powered, with released brakes, at rest, with space around it."""

    def test_state_has_the_measurement_and_its_time(self, arm: Arm) -> None:
        state, limits = arm.state(), arm.limits()
        assert state.name == arm.resources[0].name == limits.name
        assert len(state.positions_rad) == len(state.velocities_rad_s) == len(state.pose) == len(limits.joints) == 6
        assert 0 <= state.age_s < 2
        assert (state.powered, state.enabled, state.moving, state.freedrive, state.fault) == (
            True,
            True,
            False,
            False,
            "",
        )
        assert arm.safety_state() == state.safety == "normal"

    def test_a_later_state_is_measured_later(self, arm: Arm) -> None:
        first = arm.state()
        until(lambda: arm.state().measured_at > first.measured_at, "a later measurement has arrived")

    def test_move_joints_returns_at_rest_at_the_goal(self, arm: Arm) -> None:
        for part in (1.0, 0.0):
            goal = _ahead(arm, part)
            assert _off(arm.move_joints(goal, SPEED_RAD_S), goal) < NEAR_RAD
            assert not arm.state().moving

    def test_move_line_returns_at_rest_at_the_pose_and_kept_to_the_line(self, arm: Arm) -> None:
        start = arm.state().pose
        goal = [start[0], start[1], start[2] + _LINE_M, *start[3:]]
        for pose in (goal, start):
            assert _off(arm.move_line(pose, 0.05)[:3], pose[:3]) < _NEAR_M

    def test_stop_ends_a_move_short_of_its_goal_and_the_mover_hears_of_it(self, arm: Arm) -> None:
        before, goal = arm.state().positions_rad, _ahead(arm, 1.0)
        mover = Caller(lambda: arm.move_joints(goal, SPEED_RAD_S / 4))
        until(lambda: _off(arm.state().positions_rad, before) > 0.01, "it is under way")
        arm.stop()
        assert isinstance(mover.error(), MotionStopped)
        assert not arm.state().moving
        assert _off(arm.state().positions_rad, goal) > NEAR_RAD
        arm.move_joints(before, SPEED_RAD_S)

    def test_set_points_are_followed_and_end_by_themselves(self, arm: Arm) -> None:
        start, goal = arm.state().positions_rad, _ahead(arm, 0.2)
        until(lambda: arm.servo(goal, 0.3) or _off(arm.state().positions_rad, goal) < NEAR_RAD / 3, "it has arrived")
        until(lambda: not arm.resources[0].moving, "the set-point has ended")
        arm.move_joints(start, SPEED_RAD_S)

    def test_a_trajectory_is_followed_to_its_end(self, arm: Arm) -> None:
        start, goal = arm.state().positions_rad, _ahead(arm, 0.5)
        assert _off(arm.follow(_there_and_back(arm, start, goal)), start) < NEAR_RAD

    def test_a_trajectory_that_begins_elsewhere_is_refused(self, arm: Arm) -> None:
        before, elsewhere = arm.state().positions_rad, _ahead(arm, 1.0)
        with refused(ToleranceExceeded):
            arm.follow(_there_and_back(arm, elsewhere, before))
        assert _off(arm.state().positions_rad, before) < NEAR_RAD

    def test_freedrive_lasts_until_it_is_ended(self, arm: Arm) -> None:
        arm.freedrive(True)
        assert arm.state().freedrive
        assert arm.resources[0].moving
        arm.freedrive(False)
        assert not arm.state().freedrive
        arm.freedrive(True)
        arm.stop()
        assert not arm.state().freedrive

    def test_a_slower_scaling_is_reported_and_kept(self, arm: Arm) -> None:
        for fraction in (0.5, 1.0):
            arm.set_speed_scaling(fraction)
            until(lambda fraction=fraction: arm.state().speed_scaling == fraction, "the controller says so")

    def test_what_is_outside_of_the_limits_is_refused_and_nothing_moves(self, arm: Arm) -> None:
        limits, before = arm.limits(), arm.state().positions_rad
        for joint, limit in enumerate(limits.joints):
            for angle in (limit.max_rad + 0.01, limit.min_rad - 0.01):
                goal = [*before[:joint], angle, *before[joint + 1 :]]
                with refused(LimitExceeded):
                    arm.move_joints(goal)
                with refused(LimitExceeded):
                    arm.servo(goal)
        with refused(LimitExceeded):
            arm.move_joints(before, limits.joints[0].max_speed_rad_s * 1.01)
        with refused(LimitExceeded):
            arm.move_line(arm.state().pose, limits.max_speed_m_s * 1.01)
        assert _off(arm.state().positions_rad, before) < 1e-3

    def test_what_is_no_number_is_refused(self, arm: Arm) -> None:
        before = arm.state().positions_rad
        for value in (math.nan, math.inf, -math.inf):
            with refused(InvalidArgument):
                arm.move_joints([value, *before[1:]])
            with refused(InvalidArgument):
                arm.move_line([value, *arm.state().pose[1:]])
            with refused(InvalidArgument):
                arm.set_speed_scaling(value)
        for goal in ([], before[:5], [*before, 0.0]):
            with refused(InvalidArgument):
                arm.move_joints(goal)
        assert not arm.state().moving

    def test_an_unknown_pose_is_refused_with_those_there_are(self, arm: Arm) -> None:
        with refused(InvalidArgument):
            arm.move_to_pose("nowhere")

    def test_two_who_move_it_at_once_do_not_both_arrive(self, arm: Arm) -> None:
        start, goal = arm.state().positions_rad, _ahead(arm, 1.0)
        first = Caller(lambda: arm.move_joints(goal, SPEED_RAD_S / 4))
        until(lambda: arm.state().moving, "the first is under way")
        threading.Event().wait(0.05)
        assert _off(arm.move_joints(start, SPEED_RAD_S), start) < NEAR_RAD
        assert isinstance(first.error(), MotionStopped)


def _off(one: Sequence[float], other: Sequence[float]) -> float:
    return max(abs(a - b) for a, b in zip(one, other, strict=True))


def _ahead(arm: Arm, part: float) -> list[float]:
    """Returns a short motion of the last joint, to the side with more room."""
    angles, limit = arm.state().positions_rad, arm.limits().joints[-1]
    up = limit.max_rad - angles[-1] >= angles[-1] - limit.min_rad
    return [*angles[:-1], angles[-1] + (REACH_RAD if up else -REACH_RAD) * part]


def _there_and_back(arm: Arm, start: Sequence[float], goal: Sequence[float]) -> Trajectory:
    joints = [limit.name for limit in arm.limits().joints]
    way = ((0.0, start), (1.0, goal), (2.0, start))
    return Trajectory(
        joints=joints, points=[TrajectoryPoint(time_from_start_s=time, positions_rad=list(at)) for time, at in way]
    )
