"""What every Gripper promises, whoever built it: run on its simulation here, on hardware with a robot file."""

import math
import threading

import pytest

from trade.errors import InvalidArgument, LimitExceeded, MotionStopped
from trade_drivers import Gripper


class GripperContract:
    """Subclass it with a fixture ``gripper``: attached, activated, open, at rest, with nothing between its fingers."""

    def test_state_tells_what_was_measured_and_when(self, gripper: Gripper) -> None:
        state, limits = gripper.state(), gripper.limits()
        assert state.name == gripper.resources[0].name
        assert limits.min_width_m - 0.003 <= state.width_m <= limits.max_width_m + 0.003
        assert 0 <= state.age_s < 2
        assert (state.activated, state.moving, state.holding, state.fault) == (True, False, "", "")

    def test_a_later_state_is_measured_later(self, gripper: Gripper) -> None:
        first = gripper.state()
        while gripper.state().measured_at <= first.measured_at:
            threading.Event().wait(0.001)

    def test_move_to_returns_at_rest_at_the_width(self, gripper: Gripper) -> None:
        limits = gripper.limits()
        for part in (0.5, 0.25):
            goal = limits.min_width_m + part * (limits.max_width_m - limits.min_width_m)
            state = gripper.move_to(goal)
            assert state.width_m == pytest.approx(goal, abs=0.002)
            assert (state.moving, state.holding) == (False, "")

    def test_close_and_open_go_to_the_ends(self, gripper: Gripper) -> None:
        limits = gripper.limits()
        assert gripper.close().width_m == pytest.approx(limits.min_width_m, abs=0.002)
        assert gripper.open().width_m == pytest.approx(limits.max_width_m, abs=0.002)

    def test_stop_ends_a_move_short_of_its_goal_and_the_mover_hears_of_it(self, gripper: Gripper) -> None:
        start, failures = gripper.state().width_m, list[Exception]()

        def move() -> None:
            try:
                gripper.close(gripper.limits().min_speed_m_s)
            except MotionStopped as stopped:
                failures.append(stopped)

        mover = threading.Thread(target=move)
        mover.start()
        while abs(gripper.state().width_m - start) < 0.004:
            threading.Event().wait(0.002)
        gripper.stop()
        mover.join(20)
        assert [type(failure) for failure in failures] == [MotionStopped]
        assert not gripper.state().moving
        assert gripper.state().width_m > gripper.limits().min_width_m + 0.02

    def test_what_is_outside_of_the_limits_is_refused_and_nothing_moves(self, gripper: Gripper) -> None:
        limits, before = gripper.limits(), gripper.state()
        for width in (limits.max_width_m + 0.001, limits.min_width_m - 0.001, 10.0):
            with pytest.raises(LimitExceeded) as refused:
                gripper.move_to(width)
            assert refused.value.value == width
        for speed in (limits.max_speed_m_s * 1.01, limits.min_speed_m_s * 0.99, 0.0, -0.1):
            with pytest.raises(LimitExceeded):
                gripper.close(speed)
        for force in (limits.max_force_n * 1.01, limits.min_force_n * 0.99, 0.0, -1.0):
            with pytest.raises(LimitExceeded):
                gripper.close(force_n=force)
        assert gripper.state().width_m == before.width_m

    def test_what_is_no_number_is_refused(self, gripper: Gripper) -> None:
        for value in (math.nan, math.inf, -math.inf):
            for act in (
                lambda value=value: gripper.move_to(value),
                lambda value=value: gripper.close(value),
                lambda value=value: gripper.close(force_n=value),
            ):
                with pytest.raises(InvalidArgument):
                    act()
        assert not gripper.state().moving

    def test_activating_an_activated_gripper_moves_nothing(self, gripper: Gripper) -> None:
        before = gripper.move_to(gripper.limits().max_width_m / 2)
        assert gripper.activate().width_m == before.width_m
