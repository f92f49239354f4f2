"""Trajectories: what is followed, how closely, and what ends them; the judge is what the simulated servos received."""

import math
import threading
from collections.abc import Callable, Iterator, Sequence

import pytest

import trade_hil_sim
from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Outcome, Rig, call, goal_counts, written_now
from trade import where
from trade._context.call_context import CallContext, running
from trade.errors import InvalidArgument, LimitExceeded, MotionStopped, ToleranceExceeded, TradeError
from trade.testing import memory_system
from trade_drivers import AttachedRobot, FollowProgress, JointGroup, Tolerances, Trajectory, TrajectoryPoint
from trade_hil_sim import Servo

pytestmark = pytest.mark.virtual_time

COUNTS_PER_RAD = 4096 / math.tau
NAMES = ["rosie.neck.pan", "rosie.neck.tilt"]
Row = tuple[float, list[float]] | tuple[float, list[float], list[float] | None]


@pytest.fixture
def group(robot: AttachedRobot) -> JointGroup:
    return robot.group("head")


def through(*rows: Row, joints: Sequence[str] = NAMES) -> Trajectory:
    """Times, positions and velocities."""
    return Trajectory(
        joints=list(joints),
        points=[
            TrajectoryPoint(time_from_start_s=row[0], positions_rad=row[1], velocities_rad_s=(*row, None)[2])
            for row in rows
        ],
    )


WIDE = Tolerances(path_rad=1.0)
"""For what is fast: this machine may stand still for a moment, and then the joint is behind."""
SLOW = through((0.0, [0.0, 0.0]), (4.0, [1.2, 0.5]))
"""At half its way after 2 s."""


def test_it_goes_through_its_points_in_time_and_returns_at_rest(head: Rig, group: JointGroup) -> None:
    group.enable()
    mark = written_now()
    trajectory = through((0.0, [0.0, 0.0]), (0.6, [0.6, 0.1]), (1.2, [-0.3, 0.4]), (1.8, [0.0, 0.2]))
    assert group.follow(trajectory, WIDE) == pytest.approx([0.0, 0.2], abs=0.03)
    assert not any(state.moving for state in group.state())
    began = head.events("motion_started", 1, mark)[0].t
    pan = [(entry.t - began, (goal_counts(entry) - 2048) / COUNTS_PER_RAD) for entry in head.goals(1, mark)]
    assert max(angle for _, angle in pan) == pytest.approx(0.6, abs=0.05)
    assert min(angle for _, angle in pan) == pytest.approx(-0.3, abs=0.05)
    turns = [time for time, angle in pan if angle < -0.28]
    assert turns[0] > 0.4 * pan[-1][0]


def test_the_joints_may_be_named_in_any_order(group: JointGroup) -> None:
    trajectory = through((0.0, [0.0, 0.0]), (0.8, [-0.2, 0.4]), joints=NAMES[::-1])
    assert group.follow(trajectory, WIDE) == pytest.approx([0.4, -0.2], abs=0.03)


def test_with_velocities_it_is_as_fast_at_a_point_as_they_say(head: Rig, group: JointGroup) -> None:
    group.enable()
    rows = ((0.0, [0.0, 0.0], [0.0, 0.0]), (0.6, [0.3, 0.0], [0.0, 0.0]), (1.2, [0.6, 0.0], [0.0, 0.0]))
    mark = written_now()
    assert group.follow(through(*rows), WIDE) == pytest.approx([0.6, 0.0], abs=0.03)
    stood = [entry.position_rad or 0.0 for entry in head.events("at_rest", 1, mark)]
    assert any(abs(angle - 0.3) < 0.01 for angle in stood)  # without them it would have gone on


def test_it_is_followed_far_more_closely_than_the_goals_alone_would_be(robot: AttachedRobot, group: JointGroup) -> None:
    seen: list[float] = []
    trajectory = through((0.0, [0.0, 0.0]), (1.0, [1.2, 0.0]), (2.0, [0.0, 0.0]))
    with reports(seen.append):
        group.follow(trajectory, WIDE)
    speed, accel = 1.8, 20.0
    assert seen
    assert sorted(seen)[len(seen) // 2] < speed * speed / (2 * accel)


def reports(tell: Callable[[float], None]) -> "running_reports":
    return running_reports(lambda progress: tell(max(map(abs, progress.errors_rad))))


class running_reports:  # noqa: N801 - reads as a function
    """Within it, calls have a caller that hears of their progress."""

    def __init__(self, tell: Callable[[FollowProgress], None]) -> None:
        class Heard(CallContext, frozen=True):
            def progress(self, value: object) -> None:
                assert isinstance(value, FollowProgress)
                tell(value)

        self._call = Heard(id=1, service="test", caller="test", session="test", expires_ns=None)

    def __enter__(self) -> None:
        self._token = running.set(self._call)

    def __exit__(self, *_: object) -> None:
        running.reset(self._token)


def test_its_progress_rises_to_the_whole(group: JointGroup) -> None:
    heard: list[FollowProgress] = []
    with running_reports(heard.append):
        group.follow(through((0.0, [0.0, 0.0]), (1.0, [0.5, 0.2])))
    fractions = [progress.fraction for progress in heard]
    assert len(fractions) > 2
    assert fractions == sorted(fractions)
    assert 0 <= fractions[0] < fractions[-1] <= 1
    assert all(len(progress.errors_rad) == 2 for progress in heard)


def _trajectory(*rows: Row) -> Callable[[JointGroup], object]:
    return lambda group: group.follow(through(*rows))


@pytest.mark.parametrize(
    ("act", "error", "says"),
    [
        (_trajectory((0.0, [0.0, 0.0]), (5.0, [1.41, 0.0])), LimitExceeded, "neck.pan angle"),
        (_trajectory((0.0, [0.0, 0.0]), (5.0, [0.0, -0.61])), LimitExceeded, "neck.tilt angle"),
        (_trajectory((0.0, [0.0, 0.0]), (0.7, [1.2, 0.0])), LimitExceeded, "neck.pan speed"),
        (_trajectory((0.0, [0.0, 0.0]), (0.2, [0.2, 0.0])), LimitExceeded, "neck.pan acceleration"),
        (
            _trajectory((0.0, [0.0, 0.5], [0.0, 2.3]), (1.0, [0.0, 0.5], [0.0, 0.0])),
            LimitExceeded,
            "neck.tilt angle",  # only between the points
        ),
        (_trajectory((0.0, [0.0, 0.0]), (1.0, [math.nan, 0.0])), InvalidArgument, "finite"),
        (_trajectory((0.0, [0.0, 0.0]), (math.inf, [0.1, 0.0])), InvalidArgument, "finite"),
        (_trajectory((0.0, [0.0, 0.0]), (1.0, [0.1])), InvalidArgument, "takes 2"),
        (_trajectory((0.0, [0.0, 0.0])), InvalidArgument, "at least two"),
        (_trajectory(), InvalidArgument, "at least two"),
        (_trajectory((0.5, [0.0, 0.0]), (1.0, [0.1, 0.0])), InvalidArgument, "must be 0"),
        (_trajectory((0.0, [0.0, 0.0]), (1.0, [0.1, 0.0]), (1.0, [0.2, 0.0])), InvalidArgument, "must increase"),
        (_trajectory((0.0, [0.0, 0.0], [0.0, 0.0]), (1.0, [0.1, 0.0])), InvalidArgument, "at all points"),
        (
            _trajectory((0.0, [0.0, 0.0], [0.0, 0.0]), (1.0, [0.1, 0.0], [0.1, 0.0])),
            InvalidArgument,
            "must end at rest",
        ),
        (
            lambda group: group.follow(through((0.0, [0.0]), (1.0, [0.1]), joints=NAMES[:1])),
            InvalidArgument,
            "must be",
        ),
        (lambda group: group.follow(SLOW, Tolerances(path_rad=0.0)), InvalidArgument, "above 0"),
        (lambda group: group.follow(SLOW, Tolerances(goal_time_s=math.nan)), InvalidArgument, "finite"),
    ],
)
def test_S22_what_is_beyond_the_limits_or_no_trajectory_is_refused_whole(
    head: Rig, group: JointGroup, act: Callable[[JointGroup], object], error: type[TradeError], says: str
) -> None:
    with pytest.raises(error, match=says):
        act(group)
    assert not head.moves()


def test_S22_it_begins_where_the_joints_are_or_not_at_all(head: Rig, group: JointGroup) -> None:
    group.enable()
    mark = written_now()
    with pytest.raises(ToleranceExceeded, match="Begin where it is") as refused:
        group.follow(through((0.0, [0.3, 0.0]), (1.0, [0.4, 0.0])))
    assert (refused.value.device, refused.value.what) == ("rosie.neck.pan", "start")
    assert refused.value.error_rad == pytest.approx(-0.3, abs=0.01)
    assert not head.moves(since=mark)


def test_S22_from_outside_the_range_it_comes_back_in_and_never_goes_farther_out(rig: Rig) -> None:
    rig.plug(Servo(1, position_counts=2048 + 1100), Servo(2))
    group = rig.attach().group("head")
    out = 1100 / COUNTS_PER_RAD
    with pytest.raises(LimitExceeded):
        group.follow(through((0.0, [out, 0.0]), (1.0, [out + 0.1, 0.0])))
    with pytest.raises(LimitExceeded):
        group.follow(through((0.0, [out, 0.0]), (1.0, [1.5, 0.0])))
    assert not rig.moves()
    assert group.follow(through((0.0, [out, 0.0]), (1.0, [1.2, 0.0])), WIDE)[0] == pytest.approx(1.2, abs=0.03)
    assert max(goal_counts(entry) for entry in rig.goals(1)) <= 2048 + 1101


def test_one_that_lasts_longer_than_its_call_may_is_refused(head: Rig, group: JointGroup) -> None:
    with call(2.0), pytest.raises(InvalidArgument, match="deadline"):
        group.follow(SLOW)
    assert not head.moves()


def started(head: Rig, group: JointGroup, tolerances: Tolerances | None = None) -> Outcome:
    group.enable()
    mark = written_now()
    following = Outcome(lambda: group.follow(SLOW, tolerances))
    head.wait_for("motion_started", 1, mark)
    return following


def short_of_its_end(head: Rig) -> bool:
    wait_until(lambda: not head.truth(1).moving and not head.truth(2).moving, "both rest")
    return head.truth(1).position_rad < 1.1 and head.truth(2).position_rad < 0.45


def test_S08_stopping_one_joint_ends_it_for_all(head: Rig, robot: AttachedRobot, group: JointGroup) -> None:
    following = started(head, group)
    robot.motor("neck.tilt").stop()
    assert isinstance(following.wait().error, MotionStopped)
    assert short_of_its_end(head)


def test_a_new_one_takes_over_and_nothing_holds_in_between(head: Rig, group: JointGroup) -> None:
    first = started(head, group)
    wait_until(lambda: head.truth(1).position_rad > 0.5, "it is under way")
    pan, tilt = group.state()
    mark = written_now()
    turn = through(
        (0.0, [pan.position_rad, tilt.position_rad], [pan.velocity_rad_s, tilt.velocity_rad_s]),
        (1.2, [pan.position_rad + 0.4, 0.0], [0.0, 0.0]),
    )
    assert group.follow(turn, Tolerances(start_rad=0.2)) == pytest.approx([pan.position_rad + 0.4, 0.0], abs=0.03)
    assert isinstance(first.wait().error, MotionStopped)
    assert "another move" in str(first.error)
    whole = [entry for entry in head.goals(1, mark) if len(entry.data) == 12]
    [begins] = whole  # its own beginning: no hold was sent before
    braking_rad = pan.velocity_rad_s**2 / (2 * 20.0)
    assert goal_counts(begins) - 2048 > (pan.position_rad + braking_rad / 2) * COUNTS_PER_RAD  # nor to come back


def test_a_move_of_one_joint_takes_over_and_the_others_hold(head: Rig, robot: AttachedRobot, group: JointGroup) -> None:
    following = started(head, group)
    robot.motor("neck.pan").move_to(-0.2)
    assert isinstance(following.wait().error, MotionStopped)
    wait_until(lambda: not head.truth(2).moving, "the tilt joint rests")
    assert head.truth(2).position_rad < 0.45


def test_a_joint_that_leaves_its_path_stops_all(head: Rig, group: JointGroup) -> None:
    following = started(head, group, Tolerances(path_rad=0.1))
    head.sim.do(trade_hil_sim.Jam(ids=(1,)))
    error = following.wait().error
    assert isinstance(error, ToleranceExceeded)
    assert (error.device, error.what, error.tolerance_rad) == ("rosie.neck.pan", "path", 0.1)
    assert abs(error.error_rad) > 0.1
    assert short_of_its_end(head)


def test_a_joint_that_does_not_reach_the_end_is_reported(head: Rig, group: JointGroup) -> None:
    group.enable()
    following = Outcome(lambda: group.follow(through((0.0, [0.0, 0.0]), (0.5, [0.3, 0.0])), Tolerances(path_rad=9.0)))
    head.sim.do(trade_hil_sim.Jam(ids=(1,)))
    error = following.wait().error
    assert isinstance(error, ToleranceExceeded)
    assert error.what == "goal"


def test_a_joint_that_falls_silent_stops_the_others(head: Rig, group: JointGroup) -> None:
    following = started(head, group)
    head.sim.do(trade_hil_sim.Mute(ids=(1,)))
    assert isinstance(following.wait().error, TradeError)
    wait_until(lambda: not head.truth(2).moving, "the tilt joint rests")
    assert head.truth(2).position_rad < 0.45


def test_S04_held_up_for_longer_than_a_set_point_holds_it_is_over(head: Rig) -> None:
    holding_up = threading.Event()

    def healthy() -> bool:
        if holding_up.is_set():
            threading.Event().wait(0.25)  # shorter than the servos' watchdog
            holding_up.clear()
        return True

    head.configure(('driver = "dynamixel"', 'driver = "dynamixel"\nwatchdog_s = 1'))
    group = head.attach(healthy=healthy).group("head")
    following = started(head, group)
    holding_up.set()
    assert isinstance(following.wait().error, MotionStopped)
    assert "held up" in str(following.error)
    assert short_of_its_end(head)


def test_S05_it_ends_with_the_session_it_belongs_to(head: Rig) -> None:
    with memory_system() as system:
        driver, caller = system.container("driver"), system.container("caller")
        for groups, provider in head.attach().providers.items():
            driver.register(provider, groups)
        run = caller.find(where(name="follow", group="rosie.head")).with_(deadline_s=30).start(SLOW)
        head.wait_for("motion_started", 1)
        system.kill(caller)
        system.settle()
        wait_until(lambda: short_of_its_end(head), "it was stopped")
        assert not run.done() or run.exception() is not None


def test_cancelled_it_stops(head: Rig) -> None:
    with memory_system() as system:
        driver, caller = system.container("driver"), system.container("caller")
        for groups, provider in head.attach().providers.items():
            driver.register(provider, groups)
        run = caller.find(where(name="follow", group="rosie.head")).with_(deadline_s=30).start(SLOW)
        wait_until(lambda: run.progress() is not None, "it reports its progress")
        assert 0 <= run.progress()["fraction"] < 1
        run.cancel()
        with pytest.raises(TradeError):
            run.result()
        assert short_of_its_end(head)


@pytest.fixture(autouse=True)
def _no_context_left() -> Iterator[None]:
    yield
    assert running.get() is None
