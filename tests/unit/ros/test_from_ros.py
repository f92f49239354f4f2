"""What ROS has, as providers of TRADE: with its types, and with stops that reach it."""

import threading
import time
from typing import Any

import msgspec
import pytest

from tests.support.waiting import wait_until
from tests.unit.ros.memory_graph import MemoryGraph
from tests.unit.ros.robots import PATIENCE_S, Stand, apart
from trade import Handle, where
from trade.errors import ConfigurationError, DeviceFault, InvalidArgument, MotionStopped, Stopped
from trade_gateway.recording._channels import JointStates, Message
from trade_gateway.recording._sources import RecordedParts, Sources
from trade_gateway.recording._timeline import Timeline
from trade_gateway.ros._goals import ACTION
from trade_gateway.ros._graph import Goal, GoalEnd, Outcome, RosRefused, RosUnreachable

pytestmark = pytest.mark.virtual_time

TRIGGER = "std_srvs/srv/Trigger"
PART = '[[from_ros.service]]\nservice = "/lab/door"\ntype = "std_srvs/srv/SetBool"\ngroups = ["lab"]\n'
DOOR = PART + 'effect = "actuate"\nstop = "/lab/stop"\n'
TOPIC = '[[from_ros.topic]]\ntopic = "/lab/level"\ntype = "std_msgs/msg/Float64"\ngroups = ["lab"]\n'
DRIVE = (
    '[[from_ros.publish]]\ntopic = "/cmd_vel"\ntype = "geometry_msgs/msg/Twist"\ngroups = ["base"]\n'
    'effect = "actuate"\nstop = {}\nname = "drive"\n'
)
JOINTS = '[[from_ros.joints]]\ngroups = ["lab.arm"]\naction = "/arm/follow"\njoints = ["a", "b"]\nstale_after_s = 60\n'


class Lab:
    """A node of ROS with a door that is moved until it is stopped."""

    def __init__(self, stand: Stand) -> None:
        self.graph = stand.node("/lab")
        self.asked: list[Any] = []
        self.stopped = threading.Event()
        self.goes = threading.Event()
        self.waits = False
        self.graph.serve("/lab/door", "std_srvs/srv/SetBool", self._move)
        self.graph.serve("/lab/stop", TRIGGER, self._stop)

    def _move(self, request: Any, who: str, came_at: float) -> Any:
        self.asked.append((request, who))
        self.goes.set()
        if self.waits:
            self.stopped.wait(PATIENCE_S)
        return {"success": True, "message": "moved"}

    def _stop(self, request: Any, who: str, came_at: float) -> Any:
        self.stopped.set()
        return {"success": True}


def found(stand: Stand, group: str, name: str) -> Handle:
    return stand.robot.container.find(where(group=group, name=name), wait_s=PATIENCE_S)


def test_a_service_of_ros_has_its_fields_as_parameters_and_results(stand: Stand) -> None:
    lab = Lab(stand)
    stand.up(PART + 'effect = "note"\nname = "open_door"\n')
    handle = found(stand, "lab", "open_door")
    assert handle.signature.startswith("open_door(data: bool) -> ")
    assert handle.effect == "note"
    answer = handle(data=True)
    assert (answer.success, answer.message) == (True, "moved")
    assert lab.asked == [({"data": True}, "/trade")]
    with pytest.raises(InvalidArgument):
        handle("yes")


def test_a_service_of_ros_that_is_not_there_says_so(stand: Stand) -> None:
    stand.up(PART + 'effect = "read"\n')
    with pytest.raises(RosUnreachable, match="no node serves it"):
        found(stand, "lab", "door")(True)


def test_S03_what_a_caller_moves_in_ros_is_stopped_when_the_caller_is_gone(stand: Stand) -> None:
    lab = Lab(stand)
    lab.waits = True
    stand.up(DOOR)
    person = stand.memory.container("person")
    stand.memory.settle()
    person.find(where(group="lab", name="door")).with_(deadline_s=PATIENCE_S).start(True)
    assert lab.goes.wait(PATIENCE_S)
    stand.memory.kill(person)
    assert lab.stopped.wait(PATIENCE_S)


def test_S09_an_e_stop_reaches_what_moves_in_ros(stand: Stand) -> None:
    lab = Lab(stand)
    lab.waits = True
    stand.up(DOOR)
    handle = found(stand, "lab", "door")
    handle.with_(deadline_s=PATIENCE_S).start(True)
    assert lab.goes.wait(PATIENCE_S)
    report = stand.robot.container.estop("smoke")
    assert lab.stopped.wait(PATIENCE_S)
    with pytest.raises(Stopped):
        handle(True)
    stand.robot.container.estop_clear([report.id])


def test_what_does_not_answer_in_time_is_stopped_as_it_may_move(stand: Stand) -> None:
    lab = Lab(stand)
    lab.waits = True
    stand.up(DOOR + "deadline_s = 0.2\n")
    with pytest.raises(RosUnreachable, match="no answer within"):
        found(stand, "lab", "door")(True)
    assert lab.stopped.is_set()
    assert stand.container.locks() == []


def test_an_unanswered_ros_service_raises_ros_unreachable_before_the_deadline(stand: Stand) -> None:
    """By default the bridge waits as long as a call lasts."""
    lab = Lab(stand)
    lab.waits = True
    stand.up(DOOR)
    person = stand.memory.container("person")
    stand.memory.settle()
    with pytest.raises(RosUnreachable, match="no answer within"):
        person.find(where(group="lab", name="door")).with_(deadline_s=1.5)(True)
    assert lab.stopped.is_set()


def test_what_ros_refuses_does_not_count_as_moving(stand: Stand) -> None:
    stand.node("/lab").serve("/lab/door", "std_srvs/srv/SetBool", lambda request, who, _at: {"success": 1 / 0})
    stand.up(DOOR)
    with pytest.raises(RosRefused, match="division by zero"):
        found(stand, "lab", "door")(True)
    person = stand.memory.container("person")
    stand.memory.settle()
    with person.lock(where(group="lab"), wait_s=0):  # without waiting until it rests
        pass


def test_a_stop_that_ros_refuses_is_an_error(stand: Stand) -> None:
    lab = Lab(stand)
    lab._stop = lambda request, who, _at: {"success": False, "message": "jammed"}  # type: ignore[method-assign]
    stand.ros.services.pop("/lab/stop")
    lab.graph.serve("/lab/stop", TRIGGER, lab._stop)
    stand.up(DOOR)
    with pytest.raises(RosRefused, match="jammed"):
        found(stand, "lab", "stop")()


def test_a_topic_is_the_latest_message_and_an_error_when_that_is_old(stand: Stand) -> None:
    stand.up(TOPIC + "stale_after_s = 60\n" + TOPIC.replace("level", "old") + "stale_after_s = 0.001\n")
    levels = stand.node("/lab").advertise("/lab/level", "std_msgs/msg/Float64")
    level = found(stand, "lab", "level")
    with pytest.raises(RosUnreachable, match="Is the node that publishes it running"):
        level()
    levels.send({"data": 0.5})
    wait_until(lambda: _read(level) == 0.5)
    levels.send({"data": 0.75})
    wait_until(lambda: _read(level) == 0.75)
    with stand.robot.container.stream(level, hz=50) as samples:
        assert samples.next(PATIENCE_S).value.data == 0.75
    stand.node("/lab2").advertise("/lab/old", "std_msgs/msg/Float64").send({"data": 1.0})
    wait_until(lambda: _read(found(stand, "lab", "old")) is None)


def _read(handle: Handle) -> Any:
    try:
        return handle().data
    except RosUnreachable:
        return None


def heard(stand: Stand, topic: str, kind: str) -> list[Any]:
    messages: list[Any] = []
    stand.node("/listener").subscribe(topic, kind, lambda message, who: messages.append(message))
    return messages


def test_publishing_is_a_service_with_the_fields_of_the_type(stand: Stand) -> None:
    stand.up('[[from_ros.publish]]\ntopic = "/say"\ntype = "std_msgs/msg/String"\ngroups = ["lab"]\neffect = "note"\n')
    messages = heard(stand, "/say", "std_msgs/msg/String")
    found(stand, "lab", "say")("hello")
    wait_until(lambda: messages == [{"data": "hello"}])


def test_S04_what_is_published_to_move_holds_for_a_while_and_is_stopped_then(stand: Stand) -> None:
    stand.up(DRIVE + "valid_s = 0.1\n")
    messages = heard(stand, "/cmd_vel", "geometry_msgs/msg/Twist")
    found(stand, "base", "drive")(linear={"x": 0.5}, angular={})
    wait_until(lambda: len(messages) == 2)
    assert [message["linear"]["x"] for message in messages] == [0.5, 0.0]


def test_S03_what_is_published_without_an_end_is_stopped_with_the_session(stand: Stand) -> None:
    stand.up(DRIVE + "valid_s = 0\n")
    messages = heard(stand, "/cmd_vel", "geometry_msgs/msg/Twist")
    person = stand.memory.container("person")
    stand.memory.settle()
    person.find(where(group="base", name="drive"))({"x": 0.5}, {})
    wait_until(lambda: len(messages) == 1)
    person.close()
    wait_until(lambda: len(messages) == 2)
    assert messages[1]["linear"]["x"] == 0.0


def test_S08_after_a_stop_nothing_more_is_published(stand: Stand) -> None:
    stand.up(DRIVE + "valid_s = 0\n")
    messages = heard(stand, "/cmd_vel", "geometry_msgs/msg/Twist")
    drive = found(stand, "base", "drive")
    drive({"x": 0.5}, {})
    person = stand.memory.container("person")
    stand.memory.settle()
    person.find(where(group="base", name="stop"))()
    with pytest.raises(Stopped):
        drive({"x": 0.5}, {})
    wait_until(lambda: [message["linear"]["x"] for message in messages] == [0.5, 0.0])


class RosArm:
    """A node of ROS with an arm."""

    def __init__(self, stand: Stand) -> None:
        self.graph = stand.node("/arm")
        self.goals: list[Any] = []
        self.goes, self.canceled = threading.Event(), threading.Event()
        self.holds = False
        self.falls_silent = self.dies = False
        """The states of its joints end, at once or with the next motion."""
        self.result: dict[str, Any] = {}
        self.at = (0.0, 0.0)
        self.speeds = [0.0, 0.1]
        """Of b and a; none: it does not tell them."""
        self._states = self.graph.advertise("/joint_states", "sensor_msgs/msg/JointState")
        self.graph.act("/arm/follow", ACTION, self._do)
        threading.Thread(target=self._publish, name="ros-arm", daemon=True).start()

    def _publish(self) -> None:
        while not self.graph.closed:
            threading.Event().wait(0.2)
            if not self.falls_silent:
                self.tell(*self.at)

    def tell(self, *angles: float) -> None:
        self.at = angles
        self._states.send({"name": ["b", "a"], "position": list(reversed(angles)), "velocity": self.speeds})

    def _do(self, goal: Goal) -> Outcome:
        self.goals.append(goal.message["trajectory"])
        goal.feedback({"joint_names": ["a", "b"]})
        goal.when_canceled(self.canceled.set)
        self.goes.set()
        if self.holds:
            self.canceled.wait(PATIENCE_S)
            return Outcome(GoalEnd.CANCELED, {}, "canceled")
        if self.result:
            return Outcome(GoalEnd.ABORTED, self.result, "")
        self.at = tuple(goal.message["trajectory"]["points"][-1]["positions"])
        self.falls_silent = self.falls_silent or self.dies
        return Outcome(GoalEnd.SUCCEEDED, {})


@pytest.fixture
def arm(stand: Stand) -> RosArm:
    made = RosArm(stand)
    stand.up(JOINTS)
    made.tell(0.0, 0.0)
    wait_until(lambda: _state(stand) == [0.0, 0.0])
    return made


def _state(stand: Stand) -> Any:
    try:
        return [one.position_rad for one in found(stand, "lab.arm", "state")()]
    except RosUnreachable:
        return None


def test_joints_of_ros_are_read_by_their_names(stand: Stand, arm: RosArm) -> None:
    assert found(stand, "lab.arm", "joints")() == ["lab.arm.a", "lab.arm.b"]
    arm.tell(0.1, 0.2)
    wait_until(lambda: _state(stand) == [0.1, 0.2])
    [a, _] = found(stand, "lab.arm", "state")()
    assert (a.velocity_rad_s, a.effort_nm) == (0.1, None)


@pytest.mark.virtual_time
@pytest.mark.parametrize("speeds", [[0.3, 0.1], []])
def test_joints_of_ros_are_recorded_with_what_ros_knows_of_them(stand: Stand, arm: RosArm, speeds: list[float]) -> None:
    arm.speeds = speeds
    arm.tell(0.1, 0.2)
    wait_until(lambda: _state(stand) == [0.1, 0.2])
    sources = Sources(stand.robot.container, RecordedParts(groups=["lab"]), threading.Event(), Timeline())
    sources.look()
    assert sources.labels() == ["lab.arm.state"]
    messages: list[Message] = []
    wait_until(lambda: messages.extend(sources.take()) or messages)
    sources.close()
    recorded = msgspec.json.decode(messages[0].data, type=JointStates)
    assert (messages[0].channel.topic, recorded.names) == ("/lab.arm/joints", ["lab.arm.a", "lab.arm.b"])
    assert recorded.position_rad == [0.1, 0.2]
    assert recorded.velocity_rad_s == speeds[::-1]
    assert (recorded.load, recorded.enabled, recorded.fault) == ([], [], [])


def test_joints_of_ros_move_no_quicker_than_they_may(stand: Stand, arm: RosArm) -> None:
    found(stand, "lab.arm", "move_to")([0.5, -0.25])
    [trajectory] = arm.goals
    [point] = trajectory["points"]
    assert (trajectory["joint_names"], point["positions"]) == (["a", "b"], [0.5, -0.25])
    assert point["time_from_start"] == {"sec": 1, "nanosec": 500_000_000}  # 0.5 rad at 0.5 rad/s at its quickest
    with pytest.raises(InvalidArgument, match=r"at most 0\.5"):
        found(stand, "lab.arm", "move_to")([0.5, 0.5], 2.0)
    with pytest.raises(InvalidArgument, match="1 for 2 joints"):
        found(stand, "lab.arm", "move_to")([0.5])


def test_a_trajectory_is_sent_to_ros_in_the_joint_order_of_the_call(stand: Stand, arm: RosArm) -> None:
    points = [{"time_from_start_s": t, "positions_rad": [t, -t]} for t in (0.0, 1.0)]
    found(stand, "lab.arm", "follow")({"joints": ["lab.arm.b", "lab.arm.a"], "points": points})
    assert [point["positions"] for point in arm.goals[0]["points"]] == [[0.0, 0.0], [-1.0, 1.0]]


def _trajectory(last_rad_s: list[float]) -> dict[str, Any]:
    points = [
        {
            "time_from_start_s": t,
            "positions_rad": [t, -t],
            "velocities_rad_s": speeds,
            "accelerations_rad_s2": [1.0, 2.0],
        }
        for t, speeds in ((0.0, [0.0, 0.0]), (1.0, last_rad_s))
    ]
    return {"joints": ["lab.arm.b", "lab.arm.a"], "points": points}


def test_speeds_and_accelerations_are_sent_to_ros_too_and_the_last_speed_is_0(stand: Stand, arm: RosArm) -> None:
    found(stand, "lab.arm", "follow")(_trajectory([4e-7, -5e-5]))
    assert [point["velocities"] for point in arm.goals[0]["points"]] == [[0.0, 0.0], [0.0, 0.0]]
    assert [point["accelerations"] for point in arm.goals[0]["points"]] == [[2.0, 1.0], [2.0, 1.0]]


def test_a_trajectory_that_ends_in_motion_is_not_sent_to_ros(stand: Stand, arm: RosArm) -> None:
    with pytest.raises(InvalidArgument, match=r"lab\.arm\.a still has 0\.05 rad/s at the last point"):
        found(stand, "lab.arm", "follow")(_trajectory([0.0, 0.05]))
    assert arm.goals == []


@pytest.mark.parametrize("how", ["move_to", "follow"])
def test_a_motion_in_ros_is_answered_with_where_the_joints_are_at_its_end(stand: Stand, arm: RosArm, how: str) -> None:
    points = [{"time_from_start_s": 1.0, "positions_rad": [0.4, -0.4]}]
    args = {"move_to": [0.4, -0.4], "follow": {"joints": ["lab.arm.a", "lab.arm.b"], "points": points}}
    assert found(stand, "lab.arm", how)(args[how]) == [0.4, -0.4]


def test_a_motion_in_ros_after_which_nothing_is_heard_is_an_error_that_says_so(stand: Stand, arm: RosArm) -> None:
    arm.dies = True
    began = time.monotonic()
    with pytest.raises(RosUnreachable, match=r"has ended, but for .* no state of a, b arrived"):
        found(stand, "lab.arm", "move_to").with_(deadline_s=2.0)([0.4, -0.4])
    assert time.monotonic() - began < PATIENCE_S


def test_the_feedback_of_a_motion_in_ros_is_the_progress_of_the_call(stand: Stand, arm: RosArm) -> None:
    arm.holds = True
    run = found(stand, "lab.arm", "move_to").start([0.5, 0.5])
    wait_until(lambda: run.progress() is not None)
    assert run.progress()["joint_names"] == ["a", "b"]
    found(stand, "lab.arm", "stop")()
    with pytest.raises(MotionStopped):
        run.result(PATIENCE_S)


def test_what_ros_aborts_is_a_fault(stand: Stand, arm: RosArm) -> None:
    arm.result = {"error_code": -4, "error_string": "blocked"}
    with pytest.raises(DeviceFault, match="error code -4"):
        found(stand, "lab.arm", "move_to")([0.5, 0.5])


def test_a_stop_cancels_the_goal_and_the_call_says_so(stand: Stand, arm: RosArm) -> None:
    arm.holds = True
    moves, ended = apart(lambda: found(stand, "lab.arm", "move_to")([0.5, 0.5]))
    assert arm.goes.wait(PATIENCE_S)
    found(stand, "lab.arm", "stop")()
    assert arm.canceled.is_set()
    moves.join(PATIENCE_S)
    assert isinstance(ended[0], MotionStopped)


def test_S07_a_stop_waits_for_no_goal_that_is_on_its_way_and_cancels_it_when_it_arrives(
    stand: Stand, arm: RosArm, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm.holds = True
    sending, arrive, pursue = threading.Event(), threading.Event(), MemoryGraph.pursue

    def slowly(*words: Any) -> Any:
        sending.set()
        arrive.wait(PATIENCE_S)
        return pursue(*words)

    monkeypatch.setattr(MemoryGraph, "pursue", slowly)
    moves, ended = apart(lambda: found(stand, "lab.arm", "move_to").with_(deadline_s=PATIENCE_S)([0.5, 0.5]))
    assert sending.wait(PATIENCE_S)
    with pytest.raises(DeviceFault, match="is being sent"):
        found(stand, "lab.arm", "stop")()
    assert not arrive.is_set()
    arrive.set()
    assert arm.canceled.wait(PATIENCE_S)
    moves.join(PATIENCE_S)
    assert isinstance(ended[0], MotionStopped)


def test_S03_a_goal_in_ros_is_canceled_with_the_session_of_who_asked(stand: Stand, arm: RosArm) -> None:
    arm.holds = True
    person = stand.memory.container("person")
    stand.memory.settle()
    person.find(where(group="lab.arm", name="move_to")).with_(deadline_s=PATIENCE_S).start([0.5, 0.5])
    assert arm.goes.wait(PATIENCE_S)
    stand.memory.kill(person)
    assert arm.canceled.wait(PATIENCE_S)


def test_S09_an_e_stop_cancels_a_goal_in_ros(stand: Stand, arm: RosArm) -> None:
    arm.holds = True
    moves, _ = apart(lambda: found(stand, "lab.arm", "move_to")([0.5, 0.5]))
    assert arm.goes.wait(PATIENCE_S)
    report = stand.robot.container.estop("smoke")
    assert arm.canceled.wait(PATIENCE_S)
    moves.join(PATIENCE_S)
    stand.robot.container.estop_clear([report.id])


def test_parameters_are_read_and_set_where_the_file_allows_it(stand: Stand) -> None:
    stand.ros.parameters["/planner"] = {"speed": 0.5}
    entry = '[[from_ros.parameters]]\nnode = "/planner"\ngroups = ["planner"]\n'
    stand.up(entry + "set = true\n" + entry.replace('["planner"]', '["shown"]'))
    found(stand, "planner", "set_parameter")("speed", 0.25)
    assert found(stand, "planner", "parameters")() == {"speed": 0.25}
    assert [one.name for one in stand.robot.container.services(where(group="shown"))] == ["parameters"]
    with pytest.raises(RosRefused, match="it has no parameter"):
        found(stand, "planner", "set_parameter")("colour", "red")


def test_what_came_from_ros_does_not_go_back_there(stand: Stand) -> None:
    Lab(stand)
    stand.up(DOOR + '[[to_ros.service]]\ngroup = "lab"\ntype = "std_srvs/srv/Trigger"\n')
    found(stand, "lab", "stop")
    assert set(stand.ros.services) == {"/lab/door", "/lab/stop"}


def test_a_service_imported_from_ros_is_unhealthy_while_ros_is_lost(stand: Stand) -> None:
    stand.up(TOPIC)
    handle = found(stand, "lab", "level")
    stand.ros.problem = "no master"
    wait_until(lambda: handle.health == "ROS is lost: no master")
    stand.ros.problem = ""
    wait_until(lambda: handle.health == "healthy")


def test_a_message_that_stops_must_fit_its_type(stand: Stand) -> None:
    with pytest.raises(ConfigurationError, match="has no speed"):
        stand.up(DRIVE.replace("stop = {}", "stop = { speed = 0.0 }"))
    assert stand.container.services(where(group="ros")) == []
