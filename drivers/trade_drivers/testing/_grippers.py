"""The contract of Gripper, for drivers of all vendors."""

# ruff: noqa: S101 - these are tests

import math

from trade.errors import InvalidArgument, LimitExceeded, MotionStopped
from trade_drivers.interfaces._motion import Gripper
from trade_drivers.testing._asking import Caller, refused, until

_NEAR_M = 0.002


class GripperContract:
    """Subclass it with a fixture ``gripper``: attached, activated, open, at rest, with nothing between its fingers.

    The tests open and close it completely, at its limits of speed and force.
    """

    def test_state_has_the_measurement_and_its_time(self, gripper: Gripper) -> None:
        state, limits = gripper.state(), gripper.limits()
        assert state.name == gripper.resources[0].name == limits.name
        assert limits.min_width_m - 0.003 <= state.width_m <= limits.max_width_m + 0.003
        assert 0 <= state.age_s < 2
        assert (state.activated, state.moving, state.holding, state.fault) == (True, False, "", "")

    def test_a_later_state_is_measured_later(self, gripper: Gripper) -> None:
        first = gripper.state()
        until(lambda: gripper.state().measured_at > first.measured_at, "a later measurement has arrived")

    def test_move_to_returns_at_rest_at_the_width(self, gripper: Gripper) -> None:
        limits = gripper.limits()
        for part in (0.5, 0.25):
            goal = limits.min_width_m + part * (limits.max_width_m - limits.min_width_m)
            state = gripper.move_to(goal)
            assert abs(state.width_m - goal) < _NEAR_M
            assert (state.moving, state.holding) == (False, "")

    def test_close_and_open_go_to_the_ends(self, gripper: Gripper) -> None:
        limits = gripper.limits()
        assert abs(gripper.close().width_m - limits.min_width_m) < _NEAR_M
        assert abs(gripper.open().width_m - limits.max_width_m) < _NEAR_M

    def test_stop_ends_a_move_short_of_its_goal_and_the_mover_hears_of_it(self, gripper: Gripper) -> None:
        start = gripper.state().width_m
        mover = Caller(lambda: gripper.close(gripper.limits().min_speed_m_s))
        until(lambda: abs(gripper.state().width_m - start) > 2 * _NEAR_M, "it is under way")
        gripper.stop()
        assert isinstance(mover.error(), MotionStopped)
        assert not gripper.state().moving
        assert gripper.state().width_m > gripper.limits().min_width_m + 0.02

    def test_what_is_outside_of_the_limits_is_refused_and_nothing_moves(self, gripper: Gripper) -> None:
        limits, before = gripper.limits(), gripper.state()
        for width in (limits.max_width_m + 0.001, limits.min_width_m - 0.001, 10.0):
            with refused(LimitExceeded):
                gripper.move_to(width)
        for speed in (limits.max_speed_m_s * 1.01, limits.min_speed_m_s * 0.99, 0.0, -0.1):
            with refused(LimitExceeded):
                gripper.close(speed)
        for force in (limits.max_force_n * 1.01, limits.min_force_n * 0.99, 0.0, -1.0):
            with refused(LimitExceeded):
                gripper.close(force_n=force)
        assert gripper.state().width_m == before.width_m

    def test_what_is_no_number_is_refused(self, gripper: Gripper) -> None:
        for value in (math.nan, math.inf, -math.inf):
            with refused(InvalidArgument):
                gripper.move_to(value)
            with refused(InvalidArgument):
                gripper.close(value)
            with refused(InvalidArgument):
                gripper.close(force_n=value)
        assert not gripper.state().moving

    def test_activating_an_activated_gripper_moves_nothing(self, gripper: Gripper) -> None:
        before = gripper.move_to(gripper.limits().max_width_m / 2)
        assert gripper.activate().width_m == before.width_m
