"""Goals of FollowJointTrajectory move joints of TRADE, under a lock, and report their end to their clients."""

import time
from collections.abc import Sequence
from typing import Any, Literal

import pytest

from tests.support.waiting import wait_until
from tests.unit.ros.arms import FakeJoints
from tests.unit.ros.memory_graph import MemoryGraph, MemoryRos
from tests.unit.ros.robots import PATIENCE_S, Stand
from trade import where
from trade.errors import DeviceFault, ToleranceExceeded
from trade_gateway.ros._graph import GoalEnd, Outcome, RosRefused
from trade_gateway.ros_messages._conversion import ros_stamp

pytestmark = pytest.mark.virtual_time

ACTION = "control_msgs/action/FollowJointTrajectory"
ARM = '[[to_ros.trajectory]]\ngroup = "rosie.arm"\naction = "/arm/follow"\n'


class Limb(FakeJoints):
    def __init__(self, stand: Stand) -> None:
        super().__init__("rosie.arm.a", "rosie.arm.b")
        stand.robot.container.register(self, "rosie.arm")
        stand.memory.settle()


@pytest.fixture
def arm(stand: Stand) -> Any:
    made = Limb(stand)
    yield made
    made.stopped.set()


def goal(
    *points: tuple[float, Sequence[float]], names: Sequence[str] = ("a", "b"), stamp_s: float = 0.0, **more: Any
) -> dict[str, Any]:
    reported = [{"time_from_start": ros_stamp(at), "positions": list(angles)} for at, angles in points]
    return {
        "trajectory": {"header": {"stamp": ros_stamp(stamp_s)}, "joint_names": list(names), "points": reported},
        **more,
    }


TO_THERE = goal((0.0, [0.0, 0.0]), (2.0, [0.5, -0.5]))


def ended(node: MemoryGraph, asked: dict[str, Any]) -> Outcome:
    return node.pursue("/arm/follow", ACTION, asked).wait(PATIENCE_S)


def test_a_goal_is_followed_to_its_end(stand: Stand, arm: Limb) -> None:
    stand.up(ARM)
    outcome = ended(stand.node(), TO_THERE)
    assert (outcome.how, outcome.result["error_code"]) == (GoalEnd.SUCCEEDED, 0)
    [plan] = arm.plans
    assert [track.limits.name for track in plan.tracks] == ["rosie.arm.a", "rosie.arm.b"]
    assert [track.curve.duration_s for track in plan.tracks] == [2.0, 2.0]
    assert arm.at == pytest.approx([0.5, -0.5])
    assert stand.container.locks() == []


def test_the_first_point_is_where_the_joints_are_if_the_goal_begins_later(stand: Stand, arm: Limb) -> None:
    arm.at = [0.25, 0.0]
    stand.up(ARM)
    assert ended(stand.node(), goal((1.0, [0.5, 0.5]))).how is GoalEnd.SUCCEEDED
    assert [track.curve.at(0.0)[0] for track in arm.plans[0].tracks] == [0.25, 0.0]


def test_joints_may_be_in_any_order_and_have_names_of_their_own(stand: Stand, arm: Limb) -> None:
    stand.up(ARM + 'joints = { shoulder = "rosie.arm.a" }\n')
    asked = goal((0.0, [0.0, 0.0]), (2.0, [-0.5, 0.5]), names=("b", "shoulder"))
    assert ended(stand.node(), asked).how is GoalEnd.SUCCEEDED
    assert arm.at == pytest.approx([0.5, -0.5])


def profile(*points: tuple[float, float, float, float]) -> dict[str, Any]:
    """The same time, angle, speed and acceleration for both joints."""
    asked = goal(*((at, [angle] * 2) for at, angle, _, _ in points))
    for point, (_, _, speed, accel) in zip(asked["trajectory"]["points"], points, strict=True):
        point |= {"velocities": [speed] * 2, "accelerations": [accel] * 2}
    return asked


@pytest.mark.parametrize("last_rad_s", [1e-12, 4e-7, 5e-5])
def test_a_last_speed_that_no_joint_resolves_is_rest(stand: Stand, arm: Limb, last_rad_s: float) -> None:
    stand.up(ARM)
    outcome = ended(stand.node(), profile((0.0, 0.0, 0.0, 1.0), (2.0, 0.5, last_rad_s, -1.0)))
    assert (outcome.how, outcome.result["error_string"]) == (GoalEnd.SUCCEEDED, "")
    assert arm.at == pytest.approx([0.5, 0.5])


@pytest.mark.parametrize("first_s", [1e-9, 9e-4])
def test_a_first_point_that_is_almost_at_0_s_is_the_first(stand: Stand, arm: Limb, first_s: float) -> None:
    stand.up(ARM)
    assert ended(stand.node(), profile((first_s, 0.0, 0.0, 0.0), (2.0, 0.5, 0.0, 0.0))).how is GoalEnd.SUCCEEDED
    assert [track.curve.at(0.0)[0] for track in arm.plans[0].tracks] == [0.0, 0.0]
    assert [len(track.curve.pieces) for track in arm.plans[0].tracks] == [1, 1]


@pytest.mark.parametrize("first_s", [1e-3, 0.05])
def test_a_first_point_later_than_that_begins_with_the_way_there(stand: Stand, arm: Limb, first_s: float) -> None:
    stand.up(ARM)
    assert ended(stand.node(), profile((first_s, 0.0, 0.0, 0.0), (2.0, 0.5, 0.0, 0.0))).how is GoalEnd.SUCCEEDED
    assert [len(track.curve.pieces) for track in arm.plans[0].tracks] == [2, 2]


@pytest.mark.parametrize(
    ("last_rad_s", "accel", "says"),
    [
        (0.05, 0.0, "rosie.arm.a still has 0.05 rad/s at the last point"),
        (0.0, 31.0, "rosie.arm.a acceleration from 2 s on: 31 rad/s2 is outside -30 to 30"),
    ],
)
def test_S22_a_last_speed_and_accelerations_are_refused_with_joint_and_size(
    stand: Stand, arm: Limb, last_rad_s: float, accel: float, says: str
) -> None:
    stand.up(ARM)
    outcome = ended(stand.node(), profile((0.0, 0.0, 0.0, 0.0), (2.0, 0.5, last_rad_s, accel)))
    assert outcome.how is GoalEnd.ABORTED
    assert says in outcome.result["error_string"]
    assert arm.plans == []


@pytest.mark.parametrize(
    ("asked", "code", "says"),
    [
        (goal((0, [0, 0]), (1, [9.0, 0])), -1, "LimitExceeded"),
        (goal((0, [0, 0]), (1, [float("nan"), 0])), -1, "InvalidArgument"),
    ],
)
def test_a_goal_that_is_wrong_is_refused_as_published_and_nothing_moves(
    stand: Stand, arm: Limb, asked: dict[str, Any], code: int, says: str
) -> None:
    stand.up(ARM)
    outcome = ended(stand.node(), asked)
    assert (outcome.how, outcome.result["error_code"]) == (GoalEnd.ABORTED, code)
    assert says in outcome.result["error_string"]
    assert arm.plans == []


@pytest.mark.parametrize(
    ("asked", "says"),
    [
        (goal((0, [0.0]), (1, [0.1]), names=("a",)), "must include exactly a, b"),
        (goal((0, [0, 0]), (1, [0.1, 0]), names=("a", "c")), "it is for a, c"),
        (goal(), "it has no points"),
        (goal((0, [0, 0]), (1, [0.1])), "a point has 1 positions for 2 joints"),
        (goal((0, [0, 0]), (1, [0.1, 0]), stamp_s=1000.0), "it should have begun"),
        (goal((0, [0, 0]), (1, [0.1, 0]), stamp_s=4_000_000_000.0 // 2), "goals cannot be scheduled"),
    ],
)
def test_a_goal_that_no_arm_could_reach_is_rejected_and_the_one_before_it_goes_its_way(
    stand: Stand, arm: Limb, asked: dict[str, Any], says: str
) -> None:
    arm.hold = True
    stand.up(ARM)
    before = stand.node().pursue("/arm/follow", ACTION, TO_THERE)
    assert arm.goes.wait(PATIENCE_S)
    with pytest.raises(RosRefused, match=says):
        ended(stand.node("/other"), asked)
    assert not arm.stopped.is_set()
    arm.stopped.set()
    before.wait(PATIENCE_S)
    assert len(arm.plans) == 1


TOPIC = ARM + 'topic = "/arm/joint_trajectory"\n'
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"


def test_messages_of_a_topic_are_goals_and_the_newest_counts(stand: Stand, arm: Limb) -> None:
    arm.hold = True
    stand.up(TOPIC)
    topic = stand.node().advertise("/arm/joint_trajectory", TRAJECTORY)
    topic.send(TO_THERE["trajectory"])
    assert arm.goes.wait(PATIENCE_S)
    [lock] = stand.container.locks()
    assert lock.holder.purpose == "a trajectory of /teleop"
    arm.hold = False
    topic.send(goal((0.0, [0.5, -0.5]), (1.0, [0.1, 0.1]))["trajectory"])
    wait_until(lambda: arm.at == pytest.approx([0.1, 0.1]))
    assert len(arm.plans) == 2
    wait_until(lambda: stand.container.locks() == [])


@pytest.mark.parametrize("how", ["no points", "death of the node", "end of the bridge"])
def test_the_motion_of_a_topic_ends(stand: Stand, arm: Limb, how: str) -> None:
    arm.hold = True
    bridge = stand.up(TOPIC)
    topic = stand.node().advertise("/arm/joint_trajectory", TRAJECTORY)
    topic.send(TO_THERE["trajectory"])
    assert arm.goes.wait(PATIENCE_S)
    if how == "no points":
        topic.send({"joint_names": ["a", "b"]})
    elif how == "death of the node":
        stand.ros.kill("/teleop")
    else:
        bridge.close()
    assert arm.stopped.wait(PATIENCE_S)


def test_a_trajectory_of_a_topic_that_no_arm_could_follow_ends_nothing_and_moves_nothing(
    stand: Stand, arm: Limb, caplog: pytest.LogCaptureFixture
) -> None:
    arm.hold = True
    stand.up(TOPIC)
    topic = stand.node().advertise("/arm/joint_trajectory", TRAJECTORY)
    topic.send(TO_THERE["trajectory"])
    assert arm.goes.wait(PATIENCE_S)
    topic.send(goal((0.0, [0.0]), (1.0, [0.1]), names=("a",))["trajectory"])
    topic.send(goal((0.0, [0.0, 0.0]), (1.0, [0.1]))["trajectory"])
    wait_until(lambda: caplog.text.count("is rejected") == 2)
    assert not arm.stopped.is_set()
    assert len(arm.plans) == 1


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (ToleranceExceeded(device="a", bus="can0", what="path", error_rad=1, tolerance_rad=0.1), -4),
        (ToleranceExceeded(device="a", bus="can0", what="goal", error_rad=1, tolerance_rad=0.1), -5),
        (DeviceFault(device="a", bus="can0", fault="hot"), -1),
    ],
)
def test_a_failure_during_a_trajectory_ends_with_its_published_error_code(
    stand: Stand, arm: Limb, error: Exception, code: int
) -> None:
    arm.error = error
    stand.up(ARM)
    outcome = ended(stand.node(), TO_THERE)
    assert (outcome.how, outcome.result["error_code"]) == (GoalEnd.ABORTED, code)
    assert type(error).__name__ in outcome.result["error_string"]


def test_the_tightest_tolerance_holds_for_all(stand: Stand, arm: Limb) -> None:
    stand.up(ARM)
    tolerance = [{"name": "a", "position": 0.1}, {"name": "b", "position": 0.05, "velocity": 1.0}]
    off = [{"name": "a", "position": -1.0}]
    asked = {**TO_THERE, "path_tolerance": tolerance, "goal_tolerance": off, "goal_time_tolerance": ros_stamp(2.5)}
    assert ended(stand.node(), asked).how is GoalEnd.SUCCEEDED
    reported = arm.plans[0].tolerances
    assert (reported.path_rad, reported.goal_rad, reported.goal_time_s) == (0.05, 0.03, 2.5)


def test_canceling_a_goal_stops_and_gives_the_lock_back(stand: Stand, arm: Limb) -> None:
    arm.hold = True
    stand.up(ARM)
    pursuit = stand.node().pursue("/arm/follow", ACTION, TO_THERE)
    assert arm.goes.wait(PATIENCE_S)
    [lock] = stand.container.locks()
    assert lock.holder.purpose == "a trajectory of /teleop"
    pursuit.cancel()
    assert pursuit.wait(PATIENCE_S).how is GoalEnd.CANCELED
    assert arm.stopped.is_set()
    assert stand.container.locks() == []


def test_a_goal_that_takes_the_place_of_another_one_is_not_stopped_with_it(stand: Stand, arm: Limb) -> None:
    arm.hold = True
    stand.up(ARM)
    node = stand.node()
    first = node.pursue("/arm/follow", ACTION, TO_THERE)
    assert arm.goes.wait(PATIENCE_S)
    arm.hold = False
    second = node.pursue("/arm/follow", ACTION, goal((1.0, [0.3, 0.3])))
    assert first.wait(PATIENCE_S).how is GoalEnd.CANCELED
    assert second.wait(PATIENCE_S).how is GoalEnd.SUCCEEDED
    assert arm.at == pytest.approx([0.3, 0.3])


def test_S03_a_goal_ends_with_its_node(stand: Stand, arm: Limb) -> None:
    arm.hold = True
    stand.up(ARM)
    stand.node("/planner").pursue("/arm/follow", ACTION, TO_THERE)
    assert arm.goes.wait(PATIENCE_S)
    stand.ros.kill("/planner")
    assert arm.stopped.wait(PATIENCE_S)
    wait_until(lambda: stand.container.locks() == [])


def test_what_others_have_locked_no_goal_moves(stand: Stand, arm: Limb) -> None:
    stand.up(ARM)
    person = stand.memory.container("person")
    stand.memory.settle()
    with person.lock(where(group="rosie.arm"), purpose="to repair it"):
        outcome = ended(stand.node(), TO_THERE)
    assert outcome.how is GoalEnd.ABORTED
    assert "LockedByOther" in outcome.result["error_string"]
    assert "to repair it" in outcome.result["error_string"]
    assert arm.plans == []


def test_S09_an_e_stop_ends_a_goal(stand: Stand, arm: Limb) -> None:
    arm.hold = True
    stand.up(ARM)
    pursuit = stand.node().pursue("/arm/follow", ACTION, TO_THERE)
    assert arm.goes.wait(PATIENCE_S)
    report = stand.robot.container.estop("smoke")
    assert pursuit.wait(PATIENCE_S).how is not GoalEnd.CANCELED
    assert arm.stopped.is_set()
    assert "Stopped" in ended(stand.node("/again"), TO_THERE).result["error_string"]
    stand.robot.container.estop_clear([report.id])


def test_what_is_said_of_the_way_is_feedback(stand: Stand, arm: Limb) -> None:
    heard: list[Any] = []

    def reported(plan: Any) -> list[float]:
        plan.course.note("rosie.arm.a", 0.125)
        plan.course.ready(time.monotonic_ns())
        wait_until(lambda: plan.course.report(time.monotonic_ns()) or heard)
        return arm.at

    arm.stream = reported  # type: ignore[method-assign]
    stand.up(ARM)
    pursuit = stand.node().pursue("/arm/follow", ACTION, TO_THERE, heard.append)
    assert pursuit.wait(PATIENCE_S).how is GoalEnd.SUCCEEDED
    assert heard[0]["joint_names"] == ["a", "b"]
    assert heard[0]["error"]["positions"] == [-0.125, 0.0]


@pytest.mark.parametrize("version", [1, 2])
def test_the_action_has_the_fields_published_for_each_ros(version: Literal[1, 2]) -> None:
    types = MemoryRos(version).types
    asked, result, feedback = types.parts(ACTION)
    assert {field.name for field in types.fields(result)} == {"error_code", "error_string"}
    assert {"header", "joint_names", "desired", "actual", "error"} <= {one.name for one in types.fields(feedback)}
    assert types.from_bytes(asked, types.to_bytes(asked, TO_THERE))["trajectory"]["joint_names"] == ["a", "b"]
    if version == 1:  # as `rosmsg md5` prints for Noetic's
        sums = [types.definition(part)[1] for part in (asked, result, feedback)]
        assert sums == [
            "69636787b6ecbde4d61d711979bc7ecb",
            "493383b18409bfb604b4e26c676401d2",
            "10817c60c2486ef6b33e97dcd87f4474",
        ]
