"""Services of TRADE as actions of ROS: of any type, and grippers as actions of control_msgs."""

import logging
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final, cast

import msgspec

from trade import Constraint, Handle, where
from trade.errors import ConfigurationError
from trade_gateway.ros._file import ActionEntry, GripperEntry
from trade_gateway.ros._goals import Unacceptable
from trade_gateway.ros._graph import Closable, Goal, GoalEnd, Graph
from trade_gateway.ros._mapping_sync import Place, absent_name, named_services, of_name
from trade_gateway.ros._nodes import Nodes
from trade_gateway.ros.from_ros._sent_goals import TEXTS
from trade_gateway.ros.to_ros._served_goals import CallOfGoal, ServedGoals
from trade_gateway.ros_messages._conversion import RequestMapping, ResponseMapping, failure, ros_stamp
from trade_gateway.ros_messages._types import Message, Types

_logger = logging.getLogger("trade")
_REACHED_M: Final = 0.001
"""A gripper within this distance of a commanded width has reached it."""


class ActionsToRos:
    """``[[to_ros.action]]``."""

    def __init__(self, entry: ActionEntry, graph: Graph, nodes: Nodes) -> None:
        """Raises ConfigurationError: the type is not known, or has no such fields."""
        self._entry = entry
        self._graph = graph
        self._nodes = nodes
        _, result, feedback = graph.types.parts(entry.type)
        ResponseMapping(graph.types, result, entry.result)
        ResponseMapping(graph.types, feedback, entry.feedback)

    @property
    def of(self) -> Constraint:
        return of_name(self._entry.service)

    @property
    def absent(self) -> tuple[str, str]:
        return absent_name(self._entry.service, f"action {self._entry.action}")

    def places(self, found: Sequence[Handle]) -> Iterable[tuple[Place, Handle]]:
        for handle in named_services(self._entry.service, found):
            yield Place("action", self._entry.action), handle

    def open(self, place: Place, handle: Handle) -> Closable:
        meaning = _AnyAction(self._entry, self._graph.types, handle)
        goals = ServedGoals(handle, self._nodes, meaning)
        return self._graph.act(place.name, self._entry.type, goals.carry_out, goals.refuse)


class _AnyAction:
    """See `ActionMeaning`: fields by their names, or as the entry maps them."""

    def __init__(self, entry: ActionEntry, types: Types, handle: Handle) -> None:
        goal, result, feedback = types.parts(entry.type)
        self.purpose: Final = f"a goal of {entry.action}"
        self._deadline_s = entry.deadline_s
        self._arguments = RequestMapping(types, goal, handle, entry.args, entry.fixed)
        self._result = ResponseMapping(types, result, entry.result)
        self._feedback = ResponseMapping(types, feedback, entry.feedback)
        texts = [field.name for field in types.fields(result) if field.type == "string" and not field.many]
        self._text = next((name for name in TEXTS if name in texts), "")
        self._unfit = False
        """Whether progress did not fit the feedback, which is logged once."""

    def check(self, message: Message) -> None:
        """Its types are right, and only the service knows more."""

    def call_of(self, goal: Goal) -> CallOfGoal:
        return CallOfGoal(self._arguments(goal.message), self._deadline_s)

    def feedback_of(self, progress: Any) -> Message | None:
        try:
            return self._feedback(progress, time.time())
        except ConfigurationError as unfit:
            if not self._unfit:
                _logger.warning("%s gets no feedback: %s", self.purpose, unfit)
            self._unfit = True
            return None

    def result_of(self, how: GoalEnd, value: Any, error: BaseException | None) -> Message:  # noqa: ARG002 - see `ActionMeaning`
        if error is None:
            return self._result(value, time.time())
        return {self._text: failure(error)} if self._text else {}


class GrippersToRos:
    """``[[to_ros.gripper]]``."""

    def __init__(self, entry: GripperEntry, graph: Graph, nodes: Nodes) -> None:
        """Raises ConfigurationError: this ROS has no such type."""
        self._entry = entry
        self._graph = graph
        self._nodes = nodes
        graph.types.parts(entry.type)

    @property
    def of(self) -> Constraint:
        return where(group=self._entry.group, name="move_to", kind="Gripper")

    @property
    def absent(self) -> tuple[str, str]:
        return self._entry.group, f"no gripper for action {self._entry.action}"

    def places(self, found: Sequence[Handle]) -> Iterable[tuple[Place, Handle]]:
        for handle in named_services(f"{self._entry.group}.move_to", found):
            yield Place("action", self._entry.action), handle

    def open(self, place: Place, handle: Handle) -> Closable:
        entry = self._entry
        joint = entry.joint or entry.group.rpartition(".")[2]
        meaning = (
            _Gripper(entry.deadline_s) if entry.type.endswith("/GripperCommand") else _Parallel(entry.deadline_s, joint)
        )
        goals = ServedGoals(handle, self._nodes, meaning)
        return self._graph.act(place.name, entry.type, goals.carry_out, goals.refuse)


class _Gripper:
    """See `ActionMeaning`: GripperCommand, whose position is the width in m and whose effort is a force in N."""

    purpose = "a command"

    def __init__(self, deadline_s: float) -> None:
        self._deadline_s = deadline_s
        self._width_m = math.nan
        """As the newest goal commands it."""

    def check(self, message: Message) -> None:
        self._arguments(message["command"])

    def call_of(self, goal: Goal) -> CallOfGoal:
        args = self._arguments(goal.message["command"])
        self._width_m = args["width_m"]
        return CallOfGoal(args, self._deadline_s)

    def _arguments(self, command: Message) -> dict[str, float]:
        force = {"force_n": command["max_effort"]} if command["max_effort"] > 0 else {}
        return {"width_m": command["position"], **force}

    def feedback_of(self, progress: Any) -> Message | None:
        state: Any = msgspec.to_builtins(progress)
        return self._message(cast("Message", state)) if isinstance(state, dict) and "width_m" in state else None

    def result_of(self, how: GoalEnd, value: Any, error: BaseException | None) -> Message:  # noqa: ARG002 - see `ActionMeaning`
        return {} if error is not None else self._message(msgspec.to_builtins(value))

    def _message(self, state: Mapping[str, Any]) -> Message:
        return {"position": state["width_m"], "effort": state["force_n"], **self._end(state)}

    def _end(self, state: Mapping[str, Any]) -> Message:
        """A held object ends a motion before the commanded width, which is no failure."""
        reached = abs(state["width_m"] - self._width_m) <= _REACHED_M
        return {"stalled": bool(state["holding"]), "reached_goal": reached}


class _Parallel(_Gripper):
    """The same for ParallelGripperCommand, whose values are those of one joint."""

    def __init__(self, deadline_s: float, joint: str) -> None:
        super().__init__(deadline_s)
        self._joint = joint

    def _arguments(self, command: Message) -> dict[str, float]:
        if len(command["position"]) != 1 or command["name"] not in ([], [self._joint]):
            problem = (
                f"it is for {', '.join(command['name']) or 'no joint'}, but must have one position, of {self._joint}"
            )
            raise Unacceptable(-1, problem)
        further = {"speed_m_s": command["velocity"], "force_n": command["effort"]}
        return {"width_m": command["position"][0]} | {
            name: one[0] for name, one in further.items() if one and one[0] > 0
        }

    def feedback_of(self, progress: Any) -> Message | None:
        found = super().feedback_of(progress)
        return None if found is None else {"state": found["state"]}

    def _message(self, state: Mapping[str, Any]) -> Message:
        values = {"position": "width_m", "velocity": "speed_m_s", "effort": "force_n"}
        measured = {name: [state[own]] for name, own in values.items()}
        stamped = {"header": {"stamp": ros_stamp(time.time() - state["age_s"])}, "name": [self._joint]}
        return {"state": {**stamped, **measured}, **self._end(state)}
