"""Joints and arms of TRADE as a FollowJointTrajectory action, which MoveIt and others use to move robots."""

import logging
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final

import msgspec

from trade import Constraint, Container, Handle, where
from trade_gateway.ros._file import TrajectoryEntry
from trade_gateway.ros._goals import (
    ACTION,
    AT_ONCE_S,
    SUCCESSFUL,
    code_of,
    lasts_s,
    starts_late,
    tolerances_of,
    trajectory_of,
)
from trade_gateway.ros._graph import Closable, Goal, GoalEnd, Graph
from trade_gateway.ros._joints import LIMBS, beside, joints_of, limbs, measured
from trade_gateway.ros._mapping_sync import Place
from trade_gateway.ros._nodes import Nodes
from trade_gateway.ros.to_ros._served_goals import CallOfGoal, ServedGoals, text_of
from trade_gateway.ros_messages._conversion import ros_stamp, seconds
from trade_gateway.ros_messages._joint_names import JointNames
from trade_gateway.ros_messages._types import Message

_logger = logging.getLogger("trade")

_TRAJECTORY: Final = "trajectory_msgs/msg/JointTrajectory"
_ENDS_WITHIN_S: Final = 5.0
_MORE_S: Final = 15.0
"""Time of a call beyond the duration of its trajectory."""
_READ_WITHIN_S: Final = 2.0


class TrajectoriesToRos:
    """``[[to_ros.trajectory]]``."""

    def __init__(self, entry: TrajectoryEntry, graph: Graph, nodes: Nodes, container: Container) -> None:
        self._entry = entry
        self._graph = graph
        self._nodes = nodes
        self._container = container

    @property
    def of(self) -> Constraint:
        return where(group=self._entry.group, name="follow") & LIMBS

    @property
    def absent(self) -> tuple[str, str]:
        return self._entry.group, f"no joints or arm for action {self._entry.action}"

    def places(self, found: Sequence[Handle]) -> Iterable[tuple[Place, Handle]]:
        for handle in limbs(found, self._entry.group, "follow"):
            yield Place("action", self._entry.action), handle

    def open(self, place: Place, handle: Handle) -> Closable:
        entry = self._entry
        joints = joints_of(self._container, handle)
        names = JointNames(joints, short=entry.names == "last", named=entry.joints)
        trajectories = _Trajectories(beside(self._container, handle, "state"), names)
        goals = ServedGoals(handle, self._nodes, trajectories)
        served = self._graph.act(place.name, ACTION, goals.carry_out, goals.refuse)
        if not entry.topic:
            return served
        try:
            return _ClosesAll(served, TopicGoals(self._graph, entry.topic, goals))
        except BaseException:
            served.close()
            raise


class _ClosesAll:
    def __init__(self, *parts: Closable) -> None:
        self._parts = parts

    def close(self) -> None:
        for part in self._parts:
            part.close()


class TopicGoals:
    """Trajectories of a topic as goals without an answer. The newest counts; one without points ends the motion."""

    def __init__(self, graph: Graph, topic: str, goals: ServedGoals) -> None:
        self._topic = topic
        self._goals = goals
        self._zero = graph.types.zero(graph.types.parts(ACTION)[0])
        self._changed = threading.Condition()
        self._next: _TopicGoal | None = None
        self._now: _TopicGoal | None = None
        self._closed = False
        self._subscription = graph.subscribe(topic, _TRAJECTORY, self._on_message)
        self._thread = threading.Thread(target=self._run, name=f"trade-ros{topic}", daemon=True)
        self._thread.start()

    def _on_message(self, message: Message, sender: str) -> None:
        goal = _TopicGoal({**self._zero, "trajectory": message}, sender)
        ends = not message["points"]
        if ends or self._goals.refuse(goal.message) is None:
            self._replace(None if ends else goal)

    def _replace(self, goal: "_TopicGoal | None") -> None:
        with self._changed:
            self._next, before = goal, self._now
            self._changed.notify_all()
        if before is not None:
            before.cancel()

    def _run(self) -> None:
        while (goal := self._take()) is not None:
            outcome = self._goals.carry_out(goal)
            if outcome.how is GoalEnd.ABORTED:
                _logger.warning("a trajectory of %s on %s failed: %s", goal.client, self._topic, outcome.text)

    def _take(self) -> "_TopicGoal | None":
        with self._changed:
            self._now = None
            self._changed.wait_for(lambda: self._next is not None or self._closed)
            self._now, self._next = None if self._closed else self._next, None
            return self._now

    def close(self) -> None:
        """Ends the motion, and waits for its end."""
        self._subscription.close()
        with self._changed:
            self._closed = True
        self._replace(None)
        self._thread.join(_ENDS_WITHIN_S)


class _TopicGoal:
    """See `Goal`."""

    def __init__(self, message: Message, client: str) -> None:
        self.message = message
        self.client = client
        self.came_at = time.monotonic()
        self._guard = threading.Lock()
        self._canceled = False
        self._tell: list[Callable[[], object]] = []

    def feedback(self, message: Mapping[str, Any]) -> None:
        """No client has asked for it."""

    def when_canceled(self, callback: Callable[[], object]) -> None:
        with self._guard:
            if not self._canceled:
                self._tell.append(callback)
                return
        callback()

    def cancel(self) -> None:
        """Another one replaces it, or its node ends the motion."""
        with self._guard:
            self._canceled, waiting = True, self._tell
            self._tell = []
        for callback in waiting:
            callback()


class _Trajectories:
    """See `ActionMeaning`."""

    purpose = "a trajectory"

    def __init__(self, state: Handle, names: JointNames) -> None:
        self._state = state
        self._names = names

    def check(self, message: Message) -> None:
        starts_late(message, time.time())
        trajectory_of(message, self._names, dict.fromkeys(self._names.trade_names.values(), 0.0))

    def call_of(self, goal: Goal) -> CallOfGoal:
        trajectory = trajectory_of(goal.message, self._names, self._current_angles(goal))
        args = {"trajectory": trajectory, "tolerances": tolerances_of(goal.message)}
        return CallOfGoal(args, lasts_s(trajectory) + _MORE_S)

    def _current_angles(self, goal: Goal) -> dict[str, float] | None:
        """The current angles, unless the goal says where the joints begin."""
        points = goal.message["trajectory"]["points"]
        if not points or seconds(points[0]["time_from_start"]) < AT_ONCE_S:
            return None
        now = measured(list(self._names.trade_names.values()), self._state.with_(deadline_s=_READ_WITHIN_S)())
        return dict(zip(now.names, now.positions, strict=True))

    def feedback_of(self, progress: Any) -> Message:
        errors: list[float] = msgspec.to_builtins(progress)["errors_rad"]
        return {
            "header": {"stamp": ros_stamp(time.time())},
            "joint_names": self._names.ros_names,
            "error": {"positions": [-error for error in errors]},  # in ROS: desired minus actual
        }

    def result_of(self, how: GoalEnd, value: Any, error: BaseException | None) -> Message:  # noqa: ARG002 - see `ActionMeaning`
        code = code_of(error) if error is not None and how is GoalEnd.ABORTED else SUCCESSFUL
        return {"error_code": code, "error_string": "" if error is None else text_of(error)}
