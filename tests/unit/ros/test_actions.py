"""Actions of any type, in both directions: progress, results, and ends that reach the other side."""

import threading
from typing import Any

import pytest

from tests.support.waiting import wait_until
from tests.unit.ros.robots import PATIENCE_S, Stand, apart
from trade import Handle, Resource, current_call, progress, service, where
from trade.errors import Cancelled, ConfigurationError, DeviceFault, LockedByOther, MotionStopped
from trade_drivers.testing import FakeGripper
from trade_gateway.ros._graph import Goal, GoalEnd, Outcome, RosRefused, RosUnreachable

pytestmark = pytest.mark.virtual_time

DRIVE = "lab_msgs/action/Drive"
FROM = f'[[from_ros.action]]\naction = "/drive"\ntype = "{DRIVE}"\ngroups = ["base"]\n'
GO = {"distance_m": 2.0, "mode": "slow"}


class RosBase:
    """A node of ROS that drives: at once, until it is canceled, or not at all."""

    def __init__(self, stand: Stand) -> None:
        self.graph = stand.node("/base")
        self.goals: list[Any] = []
        self.goes, self.canceled, self.reports = threading.Event(), threading.Event(), threading.Event()
        self.holds = False
        self.fails = ""
        self.graph.act("/drive", DRIVE, self._drive)

    def _drive(self, goal: Goal) -> Outcome:
        self.goals.append(goal.message)
        goal.when_canceled(self.canceled.set)
        goal.feedback({"left_m": 1.5})
        self.goes.set()
        if self.holds:
            self.canceled.wait(PATIENCE_S)
            return Outcome(GoalEnd.CANCELED, {"driven_m": 0.5})
        if self.fails:
            return Outcome(GoalEnd.ABORTED, {"error_msg": self.fails})
        return Outcome(GoalEnd.SUCCEEDED, {"driven_m": goal.message["distance_m"]})


@pytest.fixture
def base(stand: Stand) -> RosBase:
    return RosBase(stand)


def drives(stand: Stand, name: str = "drive") -> Handle:
    return stand.robot.container.find(where(group="base", name=name), wait_s=PATIENCE_S)


def test_an_action_of_ros_is_a_service_with_the_fields_of_its_goal_and_its_result(stand: Stand, base: RosBase) -> None:
    stand.up(FROM)
    handle = drives(stand)
    assert handle.signature.startswith("drive(distance_m: float, mode: str) -> ")
    assert (handle.effect, handle.resources) == ("actuate", ("base.drive",))
    assert handle(**GO).driven_m == 2.0
    assert base.goals == [GO]


def test_its_feedback_is_the_progress_of_the_call(stand: Stand, base: RosBase) -> None:
    base.holds = True
    stand.up(FROM)
    run = drives(stand).start(**GO)
    wait_until(lambda: run.progress() is not None)
    assert run.progress() == {"left_m": 1.5}
    run.cancel()
    with pytest.raises((Cancelled, MotionStopped)):
        run.result(PATIENCE_S)
    assert base.canceled.is_set()


def test_a_stop_cancels_the_goal_and_says_so_to_its_caller(stand: Stand, base: RosBase) -> None:
    base.holds = True
    stand.up(FROM)
    thread, ended = apart(lambda: drives(stand)(**GO))
    assert base.goes.wait(PATIENCE_S)
    drives(stand, "stop")()
    assert base.canceled.is_set()
    thread.join(PATIENCE_S)
    assert isinstance(ended[0], MotionStopped)


def test_the_deadline_of_the_call_cancels_the_goal(stand: Stand, base: RosBase) -> None:
    base.holds = True
    stand.up(FROM)
    with pytest.raises(MotionStopped):
        drives(stand).with_(deadline_s=0.5)(**GO)
    assert base.canceled.is_set()


def test_S05_the_end_of_the_caller_cancels_the_goal(stand: Stand, base: RosBase) -> None:
    base.holds = True
    stand.up(FROM)
    caller = stand.memory.container("caller")
    caller.find(where(group="base", name="drive"), wait_s=PATIENCE_S).start(**GO)
    assert base.goes.wait(PATIENCE_S)
    caller.close()
    assert base.canceled.wait(PATIENCE_S)


def test_a_goal_that_ros_aborts_is_a_fault_with_its_text(stand: Stand, base: RosBase) -> None:
    base.fails = "a wheel is stuck"
    stand.up(FROM)
    with pytest.raises(DeviceFault, match="a wheel is stuck"):
        drives(stand)(**GO)


def test_S01_what_another_client_has_locked_gets_no_goal(stand: Stand, base: RosBase) -> None:
    stand.up(FROM)
    other = stand.memory.container("other")
    other.find(where(group="base", name="drive"), wait_s=PATIENCE_S)
    with other.lock("base"):
        with pytest.raises(LockedByOther):
            drives(stand)(**GO)
        assert base.goals == []


def test_an_action_that_moves_nothing_needs_no_lock_and_has_no_stop(stand: Stand, base: RosBase) -> None:
    stand.up(FROM + 'effect = "note"\n')
    assert drives(stand)(**GO).driven_m == 2.0
    assert stand.robot.container.services(where(group="base", name="stop")) == []
    base.holds = True
    base.goes.clear()
    run = drives(stand).start(**GO)
    assert base.goes.wait(PATIENCE_S)
    run.cancel()
    assert base.canceled.wait(PATIENCE_S)


def test_an_action_that_no_node_serves_is_an_error_that_says_so(stand: Stand) -> None:
    stand.up(FROM)
    with pytest.raises(RosUnreachable, match="/drive"):
        drives(stand)(**GO)


class Driver:
    """Drives until the test lets it arrive."""

    def __init__(self) -> None:
        self.resources = (Resource("cart"),)
        self.distances: list[float] = []
        self.goes, self.arrives, self.stopped = threading.Event(), threading.Event(), threading.Event()
        self.arrives.set()

    @service(cancel="stop")
    def drive(self, distance_m: float) -> dict[str, float]:
        self.distances.append(distance_m)
        progress({"left_m": distance_m / 2})
        self.resources[0].moving = True
        self.goes.set()
        wait_until(lambda: self.arrives.is_set() or self.stopped.is_set())
        self.resources[0].moving = False
        call = current_call()
        assert call is not None
        call.raise_if_cancelled()
        return {"driven_m": distance_m}

    @service(effect="stop")
    def stop(self) -> None:
        self.stopped.set()


TO = f'[[to_ros.action]]\nservice = "cart.drive"\naction = "/cart/drive"\ntype = "{DRIVE}"\n'


@pytest.fixture
def driver(stand: Stand) -> Driver:
    made = Driver()
    stand.robot.container.register(made, "cart")
    stand.memory.settle()
    return made


def test_a_goal_of_ros_is_a_call_with_feedback_and_a_result(stand: Stand, driver: Driver) -> None:
    stand.up(TO)
    heard: list[Any] = []
    outcome = stand.node().pursue("/cart/drive", DRIVE, GO, heard.append).wait(PATIENCE_S)
    assert (outcome.how, outcome.result["driven_m"]) == (GoalEnd.SUCCEEDED, 2.0)
    assert driver.distances == [2.0]
    assert heard == [{"left_m": 1.0}]
    assert stand.container.locks() == []


def test_fields_with_other_names_are_mapped(stand: Stand) -> None:
    mapped = 'args = { angle_rad = "distance_m" }\nresult = { driven_m = "" }\n'
    stand.up(f'[[to_ros.action]]\nservice = "rosie.head.turn"\naction = "/turn"\ntype = "{DRIVE}"\n{mapped}')
    outcome = stand.node().pursue("/turn", DRIVE, GO).wait(PATIENCE_S)
    assert (outcome.how, outcome.result["driven_m"]) == (GoalEnd.SUCCEEDED, 2.0)
    assert stand.robot.head.commands == [2.0]


@pytest.mark.parametrize("how", ["cancel", "death of the node"])
def test_the_end_of_the_client_stops_the_motion_and_gives_the_lock_back(stand: Stand, driver: Driver, how: str) -> None:
    driver.arrives.clear()
    stand.up(TO)
    pursuit = stand.node().pursue("/cart/drive", DRIVE, GO)
    assert driver.goes.wait(PATIENCE_S)
    [lock] = stand.container.locks()
    assert lock.holder.purpose == "a goal of /cart/drive of /teleop"
    if how == "cancel":
        pursuit.cancel()
        assert pursuit.wait(PATIENCE_S).how is GoalEnd.CANCELED
    else:
        stand.ros.kill("/teleop")
    assert driver.stopped.wait(PATIENCE_S)
    wait_until(lambda: stand.container.locks() == [])


def test_S01_a_goal_for_what_another_client_has_locked_is_aborted_with_the_reason(stand: Stand, driver: Driver) -> None:
    stand.up(TO)
    other = stand.memory.container("other")
    other.find(where(group="cart", name="drive"), wait_s=PATIENCE_S)
    with other.lock("cart"):
        outcome = stand.node().pursue("/cart/drive", DRIVE, GO).wait(PATIENCE_S)
    assert outcome.how is GoalEnd.ABORTED
    assert outcome.result["error_msg"].startswith("LockedByOther")
    assert driver.distances == []


def test_an_action_without_a_field_for_a_parameter_is_not_mapped_and_the_reason_is_said(stand: Stand) -> None:
    stand.up(f'[[to_ros.action]]\nservice = "rosie.head.turn"\naction = "/turn"\ntype = "{DRIVE}"\n')
    assert "no field provides 'angle_rad'" in stand.said[-1]
    with pytest.raises(RosUnreachable):
        stand.node().pursue("/turn", DRIVE, GO)


def test_a_result_field_that_the_type_does_not_have_is_an_error_of_the_file(stand: Stand) -> None:
    with pytest.raises(ConfigurationError, match="has no field 'reached_m'"):
        stand.up(TO + 'result = { reached_m = "driven_m" }\n')


COMMAND, PARALLEL = "control_msgs/action/GripperCommand", "control_msgs/action/ParallelGripperCommand"
HAND = '[[to_ros.gripper]]\ngroup = "rosie.hand"\naction = "/hand"\n'


@pytest.fixture
def hand(stand: Stand) -> FakeGripper:
    made = FakeGripper("rosie.hand")
    stand.robot.container.register(made, "rosie.hand")
    stand.memory.settle()
    stand.robot.container.find(where(group="rosie.hand", name="activate"))()
    return made


def gripped(stand: Stand, command: dict[str, Any], kind: str = COMMAND) -> Outcome:
    return stand.node().pursue("/hand", kind, {"command": command}).wait(PATIENCE_S)


@pytest.mark.parametrize(
    ("object_m", "command", "result"),
    [
        (None, {"position": 0.03, "max_effort": 0.0}, {"position": 0.03, "stalled": False, "reached_goal": True}),
        (0.05, {"position": 0.0, "max_effort": 40.0}, {"position": 0.05, "stalled": True, "reached_goal": False}),
    ],
)
def test_a_gripper_moves_to_a_width_or_holds_an_object(
    stand: Stand, hand: FakeGripper, object_m: float | None, command: dict[str, float], result: dict[str, Any]
) -> None:
    hand.object_width_m = object_m
    stand.up(HAND)
    outcome = gripped(stand, command)
    assert outcome.how is GoalEnd.SUCCEEDED
    assert outcome.result == {**result, "effort": command["max_effort"] or hand.limits().max_force_n}
    assert hand.went == [command["position"]]


def test_the_parallel_gripper_command_has_one_joint(stand: Stand, hand: FakeGripper) -> None:
    stand.up(f'{HAND}type = "{PARALLEL}"\n')
    outcome = gripped(stand, {"name": ["hand"], "position": [0.02], "velocity": [0.05], "effort": [30.0]}, PARALLEL)
    assert (outcome.how, outcome.result["reached_goal"]) == (GoalEnd.SUCCEEDED, True)
    state = outcome.result["state"]
    assert (state["name"], state["position"], state["effort"]) == (["hand"], [0.02], [30.0])


@pytest.mark.parametrize("command", [{"position": []}, {"position": [0.1, 0.2]}, {"name": ["foot"], "position": [0.0]}])
def test_a_command_for_other_joints_is_rejected_and_nothing_moves(
    stand: Stand, hand: FakeGripper, command: dict[str, Any]
) -> None:
    stand.up(f'{HAND}type = "{PARALLEL}"\n')
    with pytest.raises(RosRefused, match="must have one position, of hand"):
        gripped(stand, command, PARALLEL)
    assert hand.went == []


@pytest.mark.parametrize("width_m", [-0.1, 9.0, float("nan")])
def test_a_width_that_the_gripper_does_not_have_is_aborted_and_nothing_moves(
    stand: Stand, hand: FakeGripper, width_m: float
) -> None:
    stand.up(HAND)
    assert gripped(stand, {"position": width_m}).how is GoalEnd.ABORTED
    assert hand.went == []


def test_canceling_a_command_stops_the_fingers(stand: Stand, hand: FakeGripper) -> None:
    hand.arrives.clear()
    stand.up(HAND)
    pursuit = stand.node().pursue("/hand", COMMAND, {"command": {"position": 0.01}})
    wait_until(lambda: hand.state().moving)
    pursuit.cancel()
    assert pursuit.wait(PATIENCE_S).how is GoalEnd.CANCELED
    assert ("stop", None) in hand.commands
    assert hand.went == []
