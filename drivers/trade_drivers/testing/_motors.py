"""The contract of Motor, for drivers of all vendors."""

# ruff: noqa: N802, S101 - these are tests

import math

from trade import where
from trade.errors import InvalidArgument, LimitExceeded, LockedByOther, MotionStopped
from trade.testing import memory_system
from trade_drivers.interfaces._motion import Motor
from trade_drivers.testing._asking import NEAR_RAD, REACH_RAD, SPEED_RAD_S, Caller, ahead, refused, until


class MotorContract:
    """Subclass it with a fixture ``motor``: attached, relaxed, at rest, within its limits and free to move a little.

    It moves at most 0.12 rad from its initial position, at 0.2 rad/s. The fixture relaxes it after each test.
    """

    def test_state_has_the_measurement_and_its_time(self, motor: Motor) -> None:
        state = motor.state()
        assert state.name == motor.resources[0].name == motor.limits().name
        assert motor.limits().min_rad <= state.position_rad <= motor.limits().max_rad
        assert 0 <= state.age_s < 2
        assert (state.enabled, state.moving, state.fault) == (False, False, "")

    def test_a_later_state_is_measured_later(self, motor: Motor) -> None:
        first = motor.state()
        until(lambda: motor.state().measured_at > first.measured_at, "a later measurement has arrived")

    def test_enable_holds_where_the_joint_is_and_relax_lets_go(self, motor: Motor) -> None:
        before = motor.state().position_rad
        motor.enable()
        assert motor.state().enabled
        assert abs(motor.state().position_rad - before) < NEAR_RAD
        motor.relax()
        assert not motor.state().enabled

    def test_move_to_enables_a_relaxed_joint_and_returns_at_rest_at_the_goal(self, motor: Motor) -> None:
        goal = _goal(motor)
        assert abs(motor.move_to(goal, SPEED_RAD_S) - goal) < NEAR_RAD
        state = motor.state()
        assert state.enabled
        assert not state.moving
        assert abs(state.position_rad - goal) < NEAR_RAD

    def test_stop_ends_a_move_short_of_its_goal_and_the_mover_hears_of_it(self, motor: Motor) -> None:
        goal, mover = _under_way(motor)
        motor.stop()
        assert isinstance(mover.error(), MotionStopped)
        until(lambda: not motor.state().moving, "it is at rest")
        assert abs(motor.state().position_rad - goal) > NEAR_RAD
        assert motor.state().enabled

    def test_stop_of_a_joint_at_rest_does_nothing(self, motor: Motor) -> None:
        before = motor.state()
        motor.stop()
        assert abs(motor.state().position_rad - before.position_rad) < NEAR_RAD
        assert motor.state().enabled == before.enabled

    def test_a_new_move_takes_over_and_the_one_before_hears_of_it(self, motor: Motor) -> None:
        start = motor.state().position_rad
        _, mover = _under_way(motor)
        assert abs(motor.move_to(start, SPEED_RAD_S) - start) < NEAR_RAD
        assert isinstance(mover.error(), MotionStopped)

    def test_relax_ends_a_move(self, motor: Motor) -> None:
        _, mover = _under_way(motor)
        motor.relax()
        assert isinstance(mover.error(), MotionStopped)
        assert not motor.state().enabled

    def test_a_goal_outside_the_limits_is_refused_and_nothing_moves(self, motor: Motor) -> None:
        limits, before = motor.limits(), motor.state()
        for value in (limits.max_rad + 0.01, limits.min_rad - 0.01, 100.0):
            with refused(LimitExceeded):
                motor.move_to(value)
        assert abs(motor.state().position_rad - before.position_rad) < NEAR_RAD
        assert motor.state().enabled == before.enabled

    def test_a_speed_above_the_limit_is_refused(self, motor: Motor) -> None:
        fastest, here = motor.limits().max_speed_rad_s, motor.state().position_rad
        for speed in (fastest * 1.01, 0.0, -1.0):
            with refused(LimitExceeded):
                motor.move_to(here, speed)
        for speed in (fastest * 1.01, -fastest * 1.01):
            with refused(LimitExceeded):
                motor.set_velocity(speed)
        assert not motor.state().enabled

    def test_what_is_no_finite_number_is_refused(self, motor: Motor) -> None:
        here = motor.state().position_rad
        for value in (math.nan, math.inf, -math.inf):
            with refused(InvalidArgument):
                motor.move_to(value)
            with refused(InvalidArgument):
                motor.move_to(here, value)
            with refused(InvalidArgument):
                motor.set_velocity(value)
            with refused(InvalidArgument):
                motor.set_velocity(SPEED_RAD_S, value)
        assert not motor.state().enabled

    def test_a_set_point_holds_for_a_second_at_most(self, motor: Motor) -> None:
        for valid_s in (0.0, -0.1, 1.01):
            with refused(InvalidArgument):
                motor.set_velocity(SPEED_RAD_S, valid_s)
        assert not motor.state().enabled

    def test_S04_a_velocity_that_is_not_renewed_ends_by_itself(self, motor: Motor) -> None:
        start = motor.state().position_rad
        motor.enable()  # on a slow bus, this takes longer than the set-point is valid
        motor.set_velocity(_inwards(motor) / 2, 0.4)
        until(lambda: motor.state().moving, "it turns")
        until(lambda: not motor.state().moving, "it has come to rest by itself")
        assert 0 < (motor.state().position_rad - start) / _inwards_sign(motor, start) < REACH_RAD
        assert motor.state().enabled

    def test_S04_a_renewed_velocity_continues(self, motor: Motor) -> None:
        start, velocity, valid_s = motor.state().position_rad, _inwards(motor) / 2, 0.5

        def renewed() -> bool:
            motor.set_velocity(velocity, valid_s)
            return abs(motor.state().position_rad - start) > 1.5 * abs(velocity) * valid_s

        until(renewed, "it has gone farther than one call lets it")
        motor.set_velocity(0.0)
        until(lambda: not motor.state().moving, "zero has stopped it")

    def test_S11_a_locked_device_moves_for_its_owner_only(self, motor: Motor) -> None:
        with memory_system() as system:
            driver, owner, other = (system.container(name) for name in ("driver", "owner", "other"))
            driver.register(motor, motor.resources[0].name)
            system.settle()
            start, goal = motor.state().position_rad, _goal(motor)
            move = where(name="move_to", group=motor.resources[0].name)
            with owner.lock(where(group=motor.resources[0].name), partial=True):
                with refused(LockedByOther):
                    other.find(move)(goal, SPEED_RAD_S)
                assert abs(motor.state().position_rad - start) < NEAR_RAD
                owner.find(move).with_(deadline_s=20)(goal, SPEED_RAD_S)
            assert abs(motor.state().position_rad - goal) < NEAR_RAD
            driver.deregister(motor)


def _goal(motor: Motor) -> float:
    return ahead([motor.state()], [motor.limits()])[0]


def _inwards(motor: Motor) -> float:
    return math.copysign(SPEED_RAD_S, _goal(motor) - motor.state().position_rad)


def _inwards_sign(motor: Motor, start: float) -> float:
    limits = motor.limits()
    return 1.0 if limits.max_rad - start >= start - limits.min_rad else -1.0


def _under_way(motor: Motor) -> tuple[float, Caller[float]]:
    """Starts a slow move; returns its goal and its call."""
    motor.enable()
    start, goal = motor.state().position_rad, _goal(motor)
    mover = Caller(lambda: motor.move_to(goal, SPEED_RAD_S / 2))
    until(lambda: abs(motor.state().position_rad - start) > REACH_RAD / 8, "it is under way")
    return goal, mover
