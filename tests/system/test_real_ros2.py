"""``trade ros`` and a real ROS 2: ros2cli and nodes of rclpy, over the router of rmw_zenoh_cpp."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

import trade
from tests.conftest import StartContainer
from tests.support.real_ros2 import RealRos2, RosProgram
from tests.support.waiting import PATIENCE_S, wait_until
from tests.system.conftest import Program
from tests.system.test_ros import MIXED_1, MIXED_2, Ros1System
from trade import Container, where
from trade.errors import DeviceFault, LockedByOther, MotionStopped
from trade_drivers.testing import FakeGripper, FakeJointGroup
from trade_gateway.ros._graph import RosUnreachable

GRIP, FOLLOW = "control_msgs/action/GripperCommand", "control_msgs/action/FollowJointTrajectory"
SUCCEEDED = 4
FILE = f"""
[ros]
version = 2
router = "{{router}}"

[[to_ros.service]]
service = "rosie.neck.stop"
type = "std_srvs/srv/Trigger"

[[to_ros.lock]]
group = "rosie.neck.pan"

[[to_ros.command]]
topic = "/pan"
type = "std_msgs/msg/Float64"
service = "rosie.neck.pan.move_to"
args = {{{{ position_rad = "data" }}}}
deadman_s = 10

[[to_ros.stream]]
service = "rosie.neck.pan.state"
topic = "/pan/position"
type = "std_msgs/msg/Float64"
fields = {{{{ data = "position_rad" }}}}

[[to_ros.joint_states]]
group = "rosie.neck"

[[to_ros.trajectory]]
group = "rosie.neck"
action = "/neck/follow"
topic = "/neck/joint_trajectory"

[[to_ros.gripper]]
group = "rosie.hand"
action = "/hand"

[[to_ros.gripper]]
group = "rosie.hand"
action = "/parallel"
type = "control_msgs/action/ParallelGripperCommand"

[[from_ros.service]]
service = "/lab/door"
type = "std_srvs/srv/SetBool"
groups = ["lab"]
effect = "actuate"
stop = "/lab/halt"

[[from_ros.topic]]
topic = "/lab/level"
type = "std_msgs/msg/Float64"
groups = ["lab"]

[[from_ros.publish]]
topic = "/lab/drive"
type = "geometry_msgs/msg/Twist"
groups = ["base"]
effect = "actuate"
stop = {{{{}}}}
valid_s = 0.3

[[from_ros.action]]
action = "/other_hand"
type = "{GRIP}"
groups = ["ros.hand"]

[[from_ros.parameters]]
node = "/lab"
groups = ["lab.settings"]
set = true
"""


@pytest.fixture
def ros() -> Iterator[RealRos2]:
    made = RealRos2()
    yield made
    made.close()


class Bridged:
    """A neck and a gripper of TRADE, and a bridge."""

    def __init__(self, robot: Container, ros: RealRos2, run: Callable[..., Program], file: Path) -> None:
        self.robot = robot
        self.neck = FakeJointGroup(["rosie.neck.pan", "rosie.neck.tilt"])
        self.pan = self.neck.motors[0]
        self.hand = FakeGripper("rosie.hand")
        robot.register(self.neck, "rosie.neck")
        for motor, name in zip(self.neck.motors, ("pan", "tilt"), strict=True):
            robot.register(motor, f"rosie.neck.{name}")
            self.find(f"rosie.neck.{name}", "enable")()
        robot.register(self.hand, "rosie.hand")
        self.find("rosie.hand", "activate")()
        file.write_text(FILE.format(router=ros.endpoint))
        self.program = run("-m", "trade_gateway", "ros", file)
        while "bridged:" not in self.program.line():
            pass

    def find(self, group: str, name: str) -> Any:
        return self.robot.find(where(group=group, name=name), wait_s=PATIENCE_S)


@pytest.fixture
def bridged(start_container: StartContainer, ros: RealRos2, run: Callable[..., Program], tmp_path: Path) -> Bridged:
    return Bridged(start_container("robot"), ros, run, tmp_path / "ros.toml")


def lab(ros: RealRos2) -> RosProgram:
    node = ros.node("lab")
    node.hear("up")
    return node


def test_the_bridge_is_a_node_with_topics_services_and_actions(ros: RealRos2, bridged: Bridged) -> None:
    assert "/trade\n" in ros.ros2("node", "list").ended()
    topics = ros.ros2("topic", "list", "-t").ended()
    assert "/joint_states [sensor_msgs/msg/JointState]" in topics
    assert "/pan/position [std_msgs/msg/Float64]" in topics
    services = ros.ros2("service", "list", "-t").ended()
    assert "/rosie/neck/stop [std_srvs/srv/Trigger]" in services
    actions = ros.ros2("action", "list", "-t").ended()
    assert {f"/hand [{GRIP}]", f"/neck/follow [{FOLLOW}]"} <= set(actions.splitlines())


def test_joint_states_and_streams_are_read(ros: RealRos2, bridged: Bridged) -> None:
    bridged.find("rosie.neck.pan", "move_to")(0.25)
    states = ros.ros2("topic", "echo", "--once", "/joint_states").ended()
    assert "- pan\n- tilt\n" in states
    assert "position:\n- 0.25\n- 0.0\n" in states
    assert "data: 0.25" in ros.ros2("topic", "echo", "--once", "/pan/position").ended()


def test_a_service_call_of_the_command_line_stops_joints(ros: RealRos2, bridged: Bridged) -> None:
    said = ros.ros2("service", "call", "/rosie/neck/stop", "std_srvs/srv/Trigger").ended()
    assert "success=True" in said
    assert ("stop", None) in bridged.neck.commands


def test_P08_c_python_ros_1_and_a_real_ros_2_are_in_one_system(
    run: Callable[..., Program], tmp_path: Path, c_gripper: Path, ros: RealRos2
) -> None:
    with ExitStack() as undo:
        one = Ros1System(tmp_path)
        undo.callback(one.close)
        one.start_core()
        two = f'version = 2\nrouter = "{ros.endpoint}"'
        assert "rosie.hand is registered" in run(c_gripper).line()
        for name, text, settings in (("one", MIXED_1, one.settings), ("two", MIXED_2, two)):
            (tmp_path / f"{name}.toml").write_text(text.format(ros=settings))
            program = run("-m", "trade_gateway", "ros", tmp_path / f"{name}.toml", "--name", name)
            while "bridged:" not in program.line():
                pass
        one.node("base").repeat("/battery", 24.5, 20)
        assert "data: 24.5" in ros.ros2("topic", "echo", "--once", "/battery_of_ros1").ended()
        trade.find(where(name="move_to", group="rosie.hand"), wait_s=PATIENCE_S)(0.08)
        assert "data: 0.08" in ros.ros2("topic", "echo", "--once", "/width").ended()


def test_S03_commands_of_a_topic_move_a_joint_until_their_node_is_killed(ros: RealRos2, bridged: Bridged) -> None:
    bridged.pan.arrives.clear()
    node = ros.node("push", "/pan", "0.4")
    wait_until(lambda: bridged.pan.state().moving)
    [lock] = bridged.robot.locks()
    assert lock.holder.purpose == "commands of /push on /pan"
    node.kill()
    wait_until(lambda: ("stop", None) in bridged.pan.commands, "it is stopped")
    wait_until(lambda: bridged.robot.locks() == [], "its lock is released")


def test_S03_the_lock_of_a_node_holds_until_the_node_is_killed(ros: RealRos2, bridged: Bridged) -> None:
    node = ros.node("hold", "/rosie/neck/pan/lock")
    assert node.hear("held")["success"]
    with pytest.raises(LockedByOther, match="/hold"):
        bridged.find("rosie.neck.pan", "move_to")(0.1)
    assert bridged.pan.went == []
    node.kill()
    wait_until(lambda: bridged.robot.locks() == [], "its lock is released")
    bridged.find("rosie.neck.pan", "move_to")(0.1)


def test_a_trajectory_of_a_node_is_followed_and_one_for_other_joints_is_rejected(
    ros: RealRos2, bridged: Bridged
) -> None:
    ended = ros.node("follow", "/neck/follow", "tilt", "pan").hear("ended")
    assert (ended["status"], ended["error_code"]) == (SUCCEEDED, 0)
    assert [motor.state().position_rad for motor in bridged.neck.motors] == pytest.approx([0.3, 0.3])
    moved = list(bridged.neck.commands)
    assert ros.node("follow", "/neck/follow", "pan", "knee").hear("accepted")["accepted"] is False
    assert bridged.neck.commands == moved


def test_a_trajectory_published_from_the_command_line_is_followed(ros: RealRos2, bridged: Bridged) -> None:
    points = "[{positions: [0.0, 0.0]}, {positions: [0.2, -0.2], time_from_start: {nanosec: 200000000}}]"
    message = f"{{joint_names: [pan, tilt], points: {points}}}"
    kind = "trajectory_msgs/msg/JointTrajectory"
    ros.ros2("topic", "pub", "--rate", "2", "/neck/joint_trajectory", kind, message)
    wait_until(lambda: [motor.state().position_rad for motor in bridged.neck.motors] == pytest.approx([0.2, -0.2]))


def test_a_goal_from_the_command_line_moves_a_gripper(ros: RealRos2, bridged: Bridged) -> None:
    goal = ["action", "send_goal", "/hand", GRIP]
    said = ros.ros2(*goal, "{command: {position: 0.03}}").ended()
    assert "Goal finished with status: SUCCEEDED" in said
    assert "reached_goal: true" in said
    assert bridged.hand.went == [0.03]
    said = ros.ros2(*goal, "{command: {position: 3.0}}").ended()
    assert "Goal finished with status: ABORTED" in said
    assert bridged.hand.went == [0.03]


def test_a_goal_that_no_gripper_could_reach_is_rejected(ros: RealRos2, bridged: Bridged) -> None:
    send = ["action", "send_goal", "/parallel", "control_msgs/action/ParallelGripperCommand"]
    assert "Goal was rejected" in ros.ros2(*send, "{command: {position: [0.01, 0.02]}}").ended()
    assert bridged.hand.went == []
    said = ros.ros2(*send, "{command: {name: [hand], position: [0.01]}}").ended()
    assert "Goal finished with status: SUCCEEDED" in said
    assert bridged.hand.went == [0.01]


def test_a_node_learns_that_its_gripper_holds_something(ros: RealRos2, bridged: Bridged) -> None:
    bridged.hand.object_width_m = 0.05
    ended = ros.node("grip", "/hand", "0.0").hear("ended")
    assert (ended["status"], ended["position"], ended["stalled"]) == (SUCCEEDED, 0.05, True)


def test_S03_the_goal_of_a_killed_node_ends_and_its_motion_stops(ros: RealRos2, bridged: Bridged) -> None:
    bridged.hand.arrives.clear()
    node = ros.node("grip", "/hand", "0.0")
    wait_until(lambda: bridged.hand.state().moving)
    node.kill()
    wait_until(lambda: ("stop", None) in bridged.hand.commands, "it is stopped")
    assert bridged.hand.went == []
    wait_until(lambda: bridged.robot.locks() == [], "its lock is released")


def test_a_service_of_a_node_is_called_and_stopped(ros: RealRos2, bridged: Bridged) -> None:
    node = lab(ros)
    assert bridged.find("lab", "door")(True).message == "moved"
    assert node.hear("door")["data"] is True
    bridged.find("lab", "stop")()
    node.hear("halt")


def test_a_topic_of_a_node_is_read_and_is_an_error_when_the_node_is_killed(ros: RealRos2, bridged: Bridged) -> None:
    node = lab(ros)
    level = bridged.find("lab", "level")

    def known() -> Any:
        try:
            return level().data
        except RosUnreachable:
            return None

    wait_until(lambda: known() == 24.5)
    node.kill()
    wait_until(lambda: known() is None, "it is too old")


def test_a_published_set_point_is_followed_by_its_stop(ros: RealRos2, bridged: Bridged) -> None:
    node, drive = lab(ros), bridged.find("base", "drive")

    def heard() -> list[float]:
        return [one["x"] for one in node.has("drive")]

    def said() -> bool:  # until both ends know of each other, messages are lost
        drive({"x": 0.5, "y": 0.0, "z": 0.0}, {"x": 0.0, "y": 0.0, "z": 0.0})
        return 0.5 in heard()

    wait_until(said)
    wait_until(lambda: heard()[-1] == 0.0, "the stop message follows")


def test_the_parameters_of_a_node_are_read_and_set(ros: RealRos2, bridged: Bridged) -> None:
    lab(ros)
    parameters = bridged.find("lab.settings", "parameters")
    assert parameters()["gain"] == 1.5
    bridged.find("lab.settings", "set_parameter")("gain", 2.5)
    assert parameters()["gain"] == 2.5


def test_an_action_of_a_node_is_a_service_with_progress_and_a_result(ros: RealRos2, bridged: Bridged) -> None:
    node = ros.node("serve", "/other_hand", "0.2")
    node.hear("up")
    run = bridged.find("ros.hand", "other_hand").start({"position": 0.02, "max_effort": 5.0})
    assert run.result(PATIENCE_S).position == 0.02
    assert run.progress()["position"] == 0.01
    assert node.hear("goal") == {"what": "goal", "position": 0.02, "max_effort": 5.0}
    with pytest.raises(DeviceFault, match="aborted"):
        bridged.find("ros.hand", "other_hand")({"position": -1.0})


def test_a_stop_cancels_the_goal_at_a_node(ros: RealRos2, bridged: Bridged) -> None:
    node = ros.node("serve", "/other_hand", "60")
    node.hear("up")
    run = bridged.find("ros.hand", "other_hand").with_(deadline_s=PATIENCE_S).start({"position": 0.02})
    node.hear("goal")
    bridged.find("ros.hand", "stop")()
    node.hear("canceled")
    with pytest.raises(MotionStopped):
        run.result(PATIENCE_S)
