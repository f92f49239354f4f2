"""The contract of JointGroup, for drivers of all vendors, on one bus or several."""

# ruff: noqa: N802, S101 - these are tests

import math
import threading
from collections.abc import Callable, Sequence

from trade import where
from trade.errors import InvalidArgument, LimitExceeded, LockedByOther, MotionStopped, ToleranceExceeded
from trade.testing import memory_system
from trade_drivers.interfaces._motion import JointGroup
from trade_drivers.interfaces._trajectory import Trajectory, TrajectoryPoint
from trade_drivers.motion._plan import Tolerances
from trade_drivers.testing._asking import NEAR_RAD, REACH_RAD, SPEED_RAD_S, Caller, ahead, refused, until


class JointGroupContract:
    """Subclass it with a fixture ``group``: attached, relaxed, at rest, within its limits and free to move a little.

    Its joints move at most 0.12 rad from their initial positions, at 0.2 rad/s. The fixture relaxes it after each test.
    """

    def test_everything_is_in_the_order_of_its_joints(self, group: JointGroup) -> None:
        joints = group.joints()
        assert [state.name for state in group.state()] == joints
        assert [limits.name for limits in group.limits()] == joints
        assert [resource.name for resource in group.resources] == joints

    def test_enable_holds_all_and_relax_lets_all_go(self, group: JointGroup) -> None:
        before = _angles(group)
        group.enable()
        assert all(state.enabled for state in group.state())
        assert _near(group, before)
        group.relax()
        assert not any(state.enabled for state in group.state())

    def test_move_to_enables_all_and_returns_at_rest_at_the_goals(self, group: JointGroup) -> None:
        goals = _goals(group)
        assert _close(group.move_to(goals, SPEED_RAD_S), goals)
        assert all(state.enabled and not state.moving for state in group.state())
        assert _near(group, goals)

    def test_joints_with_ways_of_different_length_are_on_their_way_together(self, group: JointGroup) -> None:
        group.enable()
        starts, goals = _angles(group), _goals(group)
        goals[1:] = ahead(group.state()[1:], group.limits()[1:], part=0.5)
        mover = Caller(lambda: group.move_to(goals, SPEED_RAD_S / 2))
        apart: list[float] = []

        def halfway() -> bool:
            done = [
                (here - start) / (goal - start) for here, start, goal in zip(_angles(group), starts, goals, strict=True)
            ]
            if 0.4 < done[0] < 0.8:
                apart.append(max(done) - min(done))
            return done[0] >= 0.8

        until(halfway, "the first joint is nearly there")
        assert mover.error() is None
        assert apart
        assert sorted(apart)[len(apart) // 2] < 0.35

    def test_stop_ends_the_motion_of_all_and_the_mover_hears_of_it(self, group: JointGroup) -> None:
        goals = _goals(group)
        mover = _under_way(group, lambda: group.move_to(goals, SPEED_RAD_S / 2))
        group.stop()
        assert isinstance(mover.error(), MotionStopped)
        assert _rests_short_of(group, goals)

    def test_one_value_outside_its_limits_refuses_all(self, group: JointGroup) -> None:
        before = _angles(group)
        for index, limits in enumerate(group.limits()):
            wrong = list(before)
            wrong[index] = limits.max_rad + 0.01
            with refused(LimitExceeded):
                group.move_to(wrong)
            with refused(LimitExceeded):
                group.servo(wrong)
            wrong[index] = math.nan
            with refused(InvalidArgument):
                group.move_to(wrong)
        with refused(LimitExceeded):
            group.move_to(before, 1.01 * min(limits.max_speed_rad_s for limits in group.limits()))
        assert _untouched(group, before)

    def test_another_number_of_values_is_refused(self, group: JointGroup) -> None:
        before = _angles(group)
        for values in ([], [*before, 0.0]):
            with refused(InvalidArgument):
                group.move_to(values)
            with refused(InvalidArgument):
                group.servo(values)
        assert _untouched(group, before)

    def test_S04_positions_are_followed_as_long_as_they_come(self, group: JointGroup) -> None:
        group.enable()
        starts, goals = _angles(group), _goals(group)
        for step in range(1, 31):
            group.servo(_between(starts, goals, step / 30), 0.5)
            threading.Event().wait(0.02)
        until(lambda: _near(group, goals), "all have followed")
        until(lambda: not any(state.moving for state in group.state()), "all have come to rest by themselves")
        assert all(state.enabled for state in group.state())

    # --- trajectories

    def test_a_trajectory_is_followed_to_its_end(self, group: JointGroup) -> None:
        goals = _goals(group)
        assert _close(group.follow(_there(group, goals), _WIDE), goals)
        assert all(state.enabled and not state.moving for state in group.state())
        assert _near(group, goals)

    def test_its_progress_is_reported(self, group: JointGroup) -> None:
        with memory_system() as system:
            driver, caller = system.container("driver"), system.container("caller")
            driver.register(group, "contract.group")
            system.settle()
            follow = caller.find(where(name="follow", group="contract.group"))
            run = follow.with_(deadline_s=30).start(_there(group, _goals(group)), _WIDE)
            until(lambda: run.progress() is not None, "it says how far it is")
            progress = run.progress()
            assert 0 <= progress["fraction"] <= 1
            assert len(progress["errors_rad"]) == len(group.joints())
            run.result()
            driver.deregister(group)

    def test_stop_ends_a_trajectory(self, group: JointGroup) -> None:
        goals = _goals(group)
        trajectory = _there(group, goals)
        mover = _under_way(group, lambda: group.follow(trajectory, _WIDE))
        group.stop()
        assert isinstance(mover.error(), MotionStopped)
        assert _rests_short_of(group, goals)

    def test_a_move_takes_over_from_a_trajectory(self, group: JointGroup) -> None:
        starts, trajectory = _angles(group), _there(group, _goals(group))
        mover = _under_way(group, lambda: group.follow(trajectory, _WIDE))
        assert _close(group.move_to(starts, SPEED_RAD_S), starts)
        assert isinstance(mover.error(), MotionStopped)

    def test_S22_a_trajectory_beyond_the_limits_is_refused_whole(self, group: JointGroup) -> None:
        before = _angles(group)
        outside = [limits.max_rad + 0.01 for limits in group.limits()]
        jump = [1e-3 * limits.max_speed_rad_s for limits in group.limits()]
        for goals, duration_s in ((outside, 1000.0), (_goals(group), 1e-3), (_shifted(before, jump), 1e-3)):
            with refused(LimitExceeded):
                group.follow(_trajectory(group, (0.0, before), (duration_s, goals)))
        assert _untouched(group, before)

    def test_what_is_no_trajectory_is_refused(self, group: JointGroup) -> None:
        before = _angles(group)
        bent = _trajectory(group, (0.0, before), (2.0, before), (1.0, before))
        late = _trajectory(group, (1.0, before), (2.0, before))
        endless = _trajectory(group, (0.0, before), (math.inf, before))
        others = Trajectory(joints=[*group.joints()[1:], "another.robot"], points=bent.points)
        for trajectory in (bent, late, endless, others, _trajectory(group, (0.0, before)), _trajectory(group)):
            with refused(InvalidArgument):
                group.follow(trajectory)
        assert _untouched(group, before)

    def test_S22_a_trajectory_that_begins_elsewhere_is_refused(self, group: JointGroup) -> None:
        before, elsewhere = _angles(group), _goals(group)
        with refused(ToleranceExceeded):
            group.follow(_trajectory(group, (0.0, elsewhere), (2.0, elsewhere)), Tolerances(start_rad=0.02))
        assert _near(group, before)

    def test_S11_a_locked_device_moves_for_its_owner_only(self, group: JointGroup) -> None:
        with memory_system() as system:
            driver, owner, other = (system.container(name) for name in ("driver", "owner", "other"))
            driver.register(group, "contract.group")
            system.settle()
            before, goals = _angles(group), _goals(group)
            with owner.lock(where(group="contract.group"), partial=True):
                for name, arguments in (("move_to", goals), ("servo", goals), ("follow", _there(group, goals))):
                    with refused(LockedByOther):
                        other.find(where(name=name, group="contract.group"))(arguments)
            assert _untouched(group, before)
            driver.deregister(group)


_WIDE = Tolerances(path_rad=REACH_RAD)


def _angles(group: JointGroup) -> list[float]:
    return [state.position_rad for state in group.state()]


def _goals(group: JointGroup) -> list[float]:
    return ahead(group.state(), group.limits())


def _shifted(angles: Sequence[float], by: Sequence[float]) -> list[float]:
    return [angle + step for angle, step in zip(angles, by, strict=True)]


def _between(starts: Sequence[float], goals: Sequence[float], part: float) -> list[float]:
    return [start + part * (goal - start) for start, goal in zip(starts, goals, strict=True)]


def _close(angles: Sequence[float], goals: Sequence[float]) -> bool:
    return all(abs(angle - goal) < NEAR_RAD for angle, goal in zip(angles, goals, strict=True))


def _near(group: JointGroup, goals: Sequence[float]) -> bool:
    return _close(_angles(group), goals)


def _untouched(group: JointGroup, before: Sequence[float]) -> bool:
    return _near(group, before) and not any(state.enabled for state in group.state())


def _trajectory(group: JointGroup, *points: tuple[float, list[float]]) -> Trajectory:
    made = [TrajectoryPoint(time_from_start_s=time_s, positions_rad=angles) for time_s, angles in points]
    return Trajectory(joints=group.joints(), points=made)


def _there(group: JointGroup, goals: list[float]) -> Trajectory:
    """Returns a short and slow trajectory with an intermediate point."""
    starts, duration_s = _angles(group), 2 * REACH_RAD / SPEED_RAD_S
    return _trajectory(group, (0.0, starts), (duration_s / 2, _between(starts, goals, 0.5)), (duration_s, goals))


def _under_way(group: JointGroup, act: Callable[[], object]) -> Caller[object]:
    """Starts a motion, and waits until each joint moves."""
    group.enable()
    starts = _angles(group)
    mover = Caller(act)
    until(
        lambda: all(abs(here - start) > 0.01 for here, start in zip(_angles(group), starts, strict=True)),
        "all are under way",
    )
    return mover


def _rests_short_of(group: JointGroup, goals: Sequence[float]) -> bool:
    until(lambda: not any(state.moving for state in group.state()), "all are at rest")
    return all(abs(here - goal) > 0.01 for here, goal in zip(_angles(group), goals, strict=True))
