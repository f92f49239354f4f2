"""What every Motor promises, whoever built it: run on its simulation here, on hardware with a robot file."""

import math
import threading

import pytest

from trade.errors import InvalidArgument, LimitExceeded, MotionStopped
from trade_drivers import Motor


class MotorContract:
    """Subclass it with a fixture ``motor``: attached, relaxed, at rest, with its range around zero free to move in."""

    def test_state_tells_what_was_measured_and_when(self, motor: Motor) -> None:
        state = motor.state()
        assert state.name == motor.resources[0].name
        assert motor.limits().min_rad <= state.position_rad <= motor.limits().max_rad
        assert 0 <= state.age_s < 2
        assert (state.enabled, state.moving, state.fault) == (False, False, "")

    def test_a_later_state_is_measured_later(self, motor: Motor) -> None:
        first = motor.state()
        while motor.state().measured_at <= first.measured_at:
            threading.Event().wait(0.001)

    def test_enable_holds_where_the_joint_is_and_relax_lets_go(self, motor: Motor) -> None:
        before = motor.state().position_rad
        motor.enable()
        assert motor.state().enabled
        assert motor.state().position_rad == pytest.approx(before, abs=0.01)
        motor.relax()
        assert not motor.state().enabled

    def test_move_to_enables_a_relaxed_joint_and_returns_at_rest_at_the_goal(self, motor: Motor) -> None:
        goal = motor.limits().max_rad / 4
        assert motor.move_to(goal) == pytest.approx(goal, abs=0.03)
        state = motor.state()
        assert state.enabled
        assert not state.moving
        assert state.position_rad == pytest.approx(goal, abs=0.03)

    def test_stop_ends_a_move_short_of_its_goal_and_the_mover_hears_of_it(self, motor: Motor) -> None:
        motor.enable()
        start, goal = motor.state().position_rad, motor.limits().max_rad
        failures: list[Exception] = []

        def move() -> None:
            try:
                motor.move_to(goal, 0.2)
            except MotionStopped as stopped:
                failures.append(stopped)

        mover = threading.Thread(target=move)
        mover.start()
        while abs(motor.state().position_rad - start) < 0.02:
            threading.Event().wait(0.002)
        motor.stop()
        mover.join(10)
        assert [type(failure) for failure in failures] == [MotionStopped]
        rest = motor.state()
        assert rest.velocity_rad_s == pytest.approx(0, abs=0.05)
        assert rest.position_rad < goal - 0.05

    def test_stop_of_a_joint_at_rest_does_nothing(self, motor: Motor) -> None:
        before = motor.state().position_rad
        motor.stop()
        assert motor.state().position_rad == pytest.approx(before, abs=0.01)

    def test_a_goal_outside_the_limits_is_refused_and_nothing_moves(self, motor: Motor) -> None:
        limits, before = motor.limits(), motor.state()
        for value in (limits.max_rad + 0.01, limits.min_rad - 0.01, 100.0):
            with pytest.raises(LimitExceeded) as refused:
                motor.move_to(value)
            assert refused.value.value == value
        assert motor.state().position_rad == before.position_rad
        assert motor.state().enabled == before.enabled

    def test_a_speed_above_the_limit_is_refused(self, motor: Motor) -> None:
        for speed in (motor.limits().max_speed_rad_s * 1.01, 0.0, -1.0):
            with pytest.raises(LimitExceeded):
                motor.move_to(0.0, speed)

    def test_what_is_no_finite_number_is_refused(self, motor: Motor) -> None:
        for value in (math.nan, math.inf, -math.inf):
            with pytest.raises(InvalidArgument):
                motor.move_to(value)
            with pytest.raises(InvalidArgument):
                motor.move_to(0.0, value)
