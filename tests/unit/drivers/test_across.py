"""A group across two buses: its joints begin, arrive and stop together; the judge is what the servos did."""

import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

import trade_hil_sim
from tests.support.simulated_robots import HEAD, at_rest, patient
from tests.support.waiting import wait_until
from tests.unit.drivers.conftest import Outcome, call, goal_counts, written_now
from trade import Container, errors, where
from trade.testing import MemorySystem, memory_system
from trade_drivers import AttachedRobot, JointGroup, Tolerances, Trajectory, TrajectoryPoint, attach, parse
from trade_hil_sim import DynamixelBus, LogEntry, events, motion_writes, writes

pytestmark = pytest.mark.virtual_time

LEGS = (
    HEAD.replace("[group.head]", "[group.neck_only]")
    + """
[bus.left]
driver = "dynamixel"
port = "/dev/ttyLEFT"

[bus.right]
driver = "dynamixel"
port = "/dev/ttyRIGHT"
"""
    + "".join(
        f"""
[joint."{side}.{joint}"]
bus = "{side}"
id = {number}
model = "XL430-W250"
min_rad = -1.5
max_rad = 1.5
max_speed_rad_s = {speed}
max_accel_rad_s2 = 10.0
"""
        for side in ("left", "right")
        for joint, number, speed in (("hip", 1, 2.0), ("knee", 2, 1.0 if side == "right" else 2.0))
    )
    + """
[group.legs]
joints = ["left.hip", "right.hip", "right.knee", "left.knee"]
"""
)
NAMES = ["rosie.left.hip", "rosie.right.hip", "rosie.right.knee", "rosie.left.knee"]


class Walker:
    """Two simulated legs and a neck on three buses, and the driver attached to them."""

    def __init__(self, folder: Path, undo: ExitStack) -> None:
        self.robot = patient(parse(LEGS, "legs.toml"))
        self.sims: dict[str, DynamixelBus] = {}
        for bus in self.robot.buses:
            sim = DynamixelBus.from_robot(bus, self.robot.joints_on(bus.name), folder / bus.name, paced=False)
            self.sims[bus.name] = undo.enter_context(sim)
        ports = {name: str(sim.port) for name, sim in self.sims.items()}
        self.attached: AttachedRobot = undo.enter_context(attach(self.robot, announced=False, ports=ports))
        self.legs: JointGroup = self.attached.group("legs")

    def log(self, side: str) -> list[LogEntry]:
        return list(self.sims[side].log.entries)

    def truth(self, name: str) -> float:
        side, joint = name.split(".")
        number = {"hip": 1, "knee": 2}[joint]
        state = next(one for one in self.sims[side].state().devices if one.device_id == number)
        return float(state.position_rad)

    def rests(self) -> bool:
        return all(at_rest(device) for side in ("left", "right") for device in self.sims[side].state().devices)

    def moves(self, since: float = 0.0) -> list[LogEntry]:
        return [entry for side in ("left", "right") for entry in motion_writes(self.log(side), since=since)]


@pytest.fixture
def walker(tmp_path: Path) -> Iterator[Walker]:
    with ExitStack() as undo:
        yield Walker(tmp_path, undo)


def under_way(walker: Walker, act: Callable[[JointGroup], object] = lambda legs: legs.move_to([1.4] * 4)) -> Outcome:
    """A motion that has begun on both sides."""
    mark = written_now()
    moving = Outcome(lambda: act(walker.legs))
    for side in ("left", "right"):
        wait_until(lambda side=side: events(walker.log(side), "motion_started", since=mark), f"the {side} leg moves")
    return moving


def short_of_the_goal(walker: Walker) -> bool:
    wait_until(walker.rests, "both legs rest")
    return all(walker.truth(name.removeprefix("rosie.")) < 1.3 for name in NAMES)


def test_its_joints_keep_the_order_of_the_robot_file(walker: Walker) -> None:
    legs = walker.legs
    assert legs.joints() == NAMES
    assert [state.name for state in legs.state()] == NAMES
    assert [limits.name for limits in legs.limits()] == NAMES
    assert [resource.name for resource in legs.resources] == NAMES
    assert all(walker.attached.motor(r.name.removeprefix("rosie.")).resources[0] is r for r in legs.resources)
    assert legs.members["rosie.legs"] == NAMES


def test_they_begin_together_and_arrive_together_at_their_own_goals(walker: Walker) -> None:
    goals = [0.8, -0.4, 0.9, 0.1]
    walker.legs.enable()
    mark = written_now()
    assert walker.legs.move_to(goals) == pytest.approx(goals, abs=0.04)
    wait_until(walker.rests, "both legs rest")
    begun, ended = {}, {}
    for side, number, name in (("left", 1, "hip"), ("right", 1, "hip"), ("right", 2, "knee"), ("left", 2, "knee")):
        log = walker.log(side)
        begun[side, name] = events(log, "motion_started", device_id=number, since=mark)[0].t
        ended[side, name] = events(log, "at_rest", device_id=number, since=mark)[-1].t
    duration = max(ended.values()) - min(begun.values())
    assert max(begun.values()) - min(begun.values()) < 0.2 * duration
    assert max(ended.values()) - min(ended.values()) < 0.2 * duration
    assert [walker.truth(name.removeprefix("rosie.")) for name in NAMES] == pytest.approx(goals, abs=0.04)


def test_a_slower_speed_takes_longer(walker: Walker) -> None:
    walker.legs.enable()
    took: list[float] = []
    for goal, speed in ((0.4, 1.0), (0.0, 0.25)):
        mark = written_now()
        walker.legs.move_to([goal] * 4, speed)
        wait_until(walker.rests, "both legs rest")
        log = walker.log("left")
        took.append(events(log, "at_rest", since=mark)[-1].t - events(log, "motion_started", since=mark)[0].t)
    assert took[1] > 2 * took[0]


def test_relaxed_joints_are_enabled_on_both_sides_before_either_moves(walker: Walker) -> None:
    assert walker.legs.move_to([0.3] * 4) == pytest.approx([0.3] * 4, abs=0.04)
    enabled = [entry.t for side in ("left", "right") for entry in events(walker.log(side), "torque_on")]
    moved = [entry.t for side in ("left", "right") for entry in events(walker.log(side), "motion_started")]
    assert len(enabled) == 4
    assert max(enabled) < min(moved)


@pytest.mark.parametrize(
    ("act", "error"),
    [
        (lambda legs: legs.move_to([0.1, 0.1, 0.1, 1.6]), errors.LimitExceeded),
        (lambda legs: legs.move_to([0.1] * 3), errors.InvalidArgument),
        (lambda legs: legs.move_to([0.1, 0.1, math.nan, 0.1]), errors.InvalidArgument),
        (lambda legs: legs.move_to([0.1] * 4, 1.5), errors.LimitExceeded),
        (lambda legs: legs.move_to([0.1] * 4, 0.0), errors.LimitExceeded),
        (lambda legs: legs.servo([0.1, 0.1, 0.1, -1.6]), errors.LimitExceeded),
        (lambda legs: legs.servo([0.1] * 4, 1.1), errors.InvalidArgument),
    ],
)
def test_S22_one_value_outside_refuses_all_on_both_buses(
    walker: Walker, act: Callable[[JointGroup], object], error: type[errors.TradeError]
) -> None:
    with pytest.raises(error):
        act(walker.legs)
    assert not walker.moves()


def test_stop_stops_all(walker: Walker) -> None:
    moving = under_way(walker)
    walker.legs.stop()
    assert walker.rests()
    assert isinstance(moving.wait().error, errors.MotionStopped)
    assert short_of_the_goal(walker)


def test_S08_stopping_one_joint_stops_the_other_bus_too(walker: Walker) -> None:
    moving = under_way(walker)
    walker.attached.motor("left.knee").stop()
    error = moving.wait().error
    assert isinstance(error, errors.MotionStopped)
    assert "stop() was called" in str(error)
    assert short_of_the_goal(walker)


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_joint_that_is_blocked_stops_the_other_bus_and_is_named(walker: Walker, side: str) -> None:
    moving = under_way(walker)
    walker.sims[side].do(trade_hil_sim.Jam(ids=(1,)))
    error = moving.wait().error
    assert isinstance(error, errors.ToleranceExceeded)
    assert error.device == f"rosie.{side}.hip"
    assert short_of_the_goal(walker)


def test_a_bus_that_falls_silent_stops_the_other(walker: Walker) -> None:
    moving = under_way(walker)
    walker.sims["left"].do(trade_hil_sim.Mute())
    assert isinstance(moving.wait().error, errors.TradeError)
    wait_until(lambda: not any(device.moving for device in walker.sims["right"].state().devices), "it rests")
    assert walker.truth("right.hip") < 1.3
    walker.sims["left"].do(trade_hil_sim.Heal())  # so that closing reaches it


def test_a_fault_on_one_side_keeps_the_other_from_moving(walker: Walker) -> None:
    walker.legs.enable()
    walker.sims["right"].do(trade_hil_sim.HardwareFault(ids=(2,), bits=0x20))
    wait_until(lambda: walker.legs.state()[2].fault, "the fault is known")
    mark = written_now()
    with pytest.raises(errors.DeviceFault, match=r"right\.knee"):
        walker.legs.move_to([0.5] * 4)
    wait_until(walker.rests, "nothing moves")
    assert not writes(walker.log("right"), register="goal_position", since=mark)
    assert abs(walker.truth("left.hip")) < 0.01


def test_a_new_move_takes_over_on_both_buses(walker: Walker) -> None:
    old = under_way(walker)
    goals = [-0.3, 0.2, -0.1, 0.3]
    assert walker.legs.move_to(goals) == pytest.approx(goals, abs=0.04)
    assert isinstance(old.wait().error, errors.MotionStopped)


def test_servo_is_followed_on_both_buses_and_S04_ends_on_both(walker: Walker) -> None:
    for step in range(1, 30):
        walker.legs.servo([0.02 * step, -0.01 * step, 0.01 * step, 0.0], 1.0)
    wait_until(lambda: abs(walker.truth("left.hip") - 0.58) < 0.02, "the left one has followed")
    wait_until(lambda: abs(walker.truth("right.hip") + 0.29) < 0.02, "the right one has followed")
    walker.legs.servo([-1.4] * 4, 0.1)
    wait_until(walker.rests, "they rest")
    assert all(walker.truth(name.removeprefix("rosie.")) > -1.2 for name in NAMES)


def test_a_servo_stream_that_one_side_cannot_follow_stops_the_other_side(walker: Walker) -> None:
    walker.legs.enable()
    walker.sims["right"].do(trade_hil_sim.HardwareFault(ids=(2,), bits=0x20))
    wait_until(lambda: walker.legs.state()[2].fault, "the fault is known")
    with pytest.raises(errors.DeviceFault):
        walker.legs.servo([1.4] * 4, 1.0)
    wait_until(walker.rests, "they rest")
    assert walker.truth("left.hip") < 1.0


def test_a_trajectory_is_followed_in_the_same_time_on_both_buses(walker: Walker) -> None:
    trajectory = Trajectory(
        joints=sorted(NAMES),
        points=[
            TrajectoryPoint(time_from_start_s=0.0, positions_rad=[0.0] * 4),
            TrajectoryPoint(time_from_start_s=1.0, positions_rad=[0.5, 0.1, -0.4, 0.2]),
            TrajectoryPoint(time_from_start_s=2.0, positions_rad=[0.0, 0.3, 0.0, 0.1]),
        ],
    )
    walker.legs.enable()
    mark = written_now()
    assert walker.legs.follow(trajectory, Tolerances(path_rad=0.3)) == pytest.approx([0.0, 0.0, 0.1, 0.3], abs=0.03)
    peak = {side: max(_far(walker, side, mark)) for side in ("left", "right")}
    duration = max(entry.t for entry in walker.moves(mark)) - min(entry.t for entry in walker.moves(mark))
    assert abs(peak["left"][1] - peak["right"][1]) < 0.15 * duration


def _far(walker: Walker, side: str, mark: float) -> list[tuple[int, float]]:
    """How far out each goal of its hip is, and when it was sent."""
    goals = writes(walker.log(side), device_id=1, register="goal_position", since=mark)
    return [(abs(goal_counts(entry) - 2048), entry.t) for entry in goals]


def _announced(walker: Walker, driver: Container, system: MemorySystem) -> None:
    for group, provider in walker.attached.providers.items():
        driver.register(provider, group)
    system.settle()


def test_S11_a_joint_locked_by_another_client_makes_the_whole_group_refuse(walker: Walker) -> None:
    with memory_system() as system:
        driver, owner, other = (system.container(name) for name in ("driver", "owner", "other"))
        _announced(walker, driver, system)
        move = other.find(where(name="move_to", group="rosie.legs"))
        with owner.lock(where(group="rosie.left.knee")), pytest.raises(errors.TradeError, match=r"left\.knee"):
            move([0.3] * 4)
        assert not walker.moves()
        assert move.with_(deadline_s=20)([0.3] * 4) == pytest.approx([0.3] * 4, abs=0.04)


def test_S08_a_stop_by_another_client_latches_on_both_buses(walker: Walker) -> None:
    with memory_system() as system:
        driver, mover, other = (system.container(name) for name in ("driver", "mover", "other"))
        _announced(walker, driver, system)
        run = mover.find(where(name="move_to", group="rosie.legs")).with_(deadline_s=20).start([1.4] * 4)
        for side in ("left", "right"):
            wait_until(lambda side=side: events(walker.log(side), "motion_started"), f"the {side} leg moves")
        other.find(where(name="stop", group="rosie.legs"))()
        with pytest.raises(errors.MotionStopped):
            run.result()
        assert short_of_the_goal(walker)
        for joint in ("left.hip", "right.knee"):
            with pytest.raises(errors.Stopped):
                mover.find(where(name="move_to", group=f"rosie.{joint}"))(0.0)


def test_a_deadline_that_comes_on_the_way_stops_both(walker: Walker) -> None:
    walker.legs.enable()
    with call(0.8), pytest.raises(errors.MotionStopped, match="deadline"):
        walker.legs.move_to([1.4] * 4, 0.5)
    assert short_of_the_goal(walker)
