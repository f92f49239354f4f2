"""A ROS 2 action server."""

import logging
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, Final

from trade_gateway.ros._graph import Goal, GoalEnd, Outcome, Refuse
from trade_gateway.ros.ros2._action import ANY, CANCEL, ENDS, STATUS, Refusal, Status, uuid
from trade_gateway.ros.ros2._node import Node
from trade_gateway.ros.ros2._services import Server, ServiceRequest
from trade_gateway.ros.ros2._topics import Topic
from trade_gateway.ros_messages._types import Message

_MOST_ENDED: Final = 32
"""Number of results kept for late requests; a client of ROS 2 asks as soon as its goal is accepted."""
_END_S: Final = 5.0

_log: Final = logging.getLogger("trade")


class ReceivedGoal(Goal):
    """A goal that a client has sent."""

    def __init__(self, action: "Action", goal_id: bytes, message: Message, came_at: float) -> None:
        self.id: Final = goal_id
        self.stamp_ns: Final = time.time_ns()
        self.status = Status.ACCEPTED
        self.outcome: Outcome | None = None
        self.waiting: Final[list[ServiceRequest]] = []
        self.thread: threading.Thread | None = None
        self.of = ""
        """Its client; unknown until the goal begins."""
        self._action = action
        self._message = message
        self._came_at = came_at
        self._lock = threading.Lock()
        self._canceled = False
        self._tell: list[Callable[[], object]] = []

    @property
    def message(self) -> Message:
        return self._message

    @property
    def client(self) -> str:
        return self.of

    @property
    def came_at(self) -> float:
        return self._came_at

    def feedback(self, message: Mapping[str, Any]) -> None:
        """See `Goal`. Raises ConfigurationError: the message does not fit the type."""
        self._action.feedback.send({"goal_id": uuid(self.id), "feedback": message})

    def when_canceled(self, callback: Callable[[], object]) -> None:
        """See `Goal`."""
        with self._lock:
            if not self._canceled:
                self._tell.append(callback)
                return
        callback()

    @property
    def canceled(self) -> bool:
        """Whether its cancellation was requested."""
        with self._lock:
            return self._canceled

    def cancel(self) -> None:
        """Runs the callbacks registered with `when_canceled`. Idempotent."""
        with self._lock:
            self._canceled = True
            callbacks, self._tell = self._tell, []
        for tell in callbacks:
            try:
                tell()
            except Exception:  # noqa: BLE001 - the remaining callbacks must still run
                _log.exception("a callback for the canceled goal of %s failed", self.of or "a client")

    def info(self) -> dict[str, Any]:
        """A ``action_msgs/msg/GoalInfo``."""
        return {"goal_id": uuid(self.id), "stamp": stamp(self.stamp_ns)}


class Action:
    """The services and topics of an action, and the goals that it has received."""

    def __init__(
        self, node: Node, name: str, type_name: str, do: Callable[[Goal], Outcome], refuse: Refuse | None = None
    ) -> None:
        node.hashes.learn_action(type_name)
        self._node = node
        self._name = name
        self._type_name = type_name
        self._do = do
        self._refuse = refuse
        self._lock = threading.Lock()
        self._goals: dict[bytes, ReceivedGoal] = {}
        self._closed = False
        start = f"{name}/_action"
        self.feedback: Final = Topic(node, f"{start}/feedback", f"{type_name}_FeedbackMessage", latched=False)
        self._status = Topic(node, f"{start}/status", STATUS, latched=True)
        self._servers = (
            Server(node, f"{start}/cancel_goal", CANCEL, self._cancel, stops=True),
            Server(node, f"{start}/get_result", f"{type_name}_GetResult", self._result),
            Server(node, f"{start}/send_goal", f"{type_name}_SendGoal", self._accept),
        )

    def close(self) -> None:
        """Accepts no more goals, cancels the current ones and waits some seconds for their end. Idempotent."""
        with self._lock:
            self._closed = True
            going = self._going()
        for goal in going:
            goal.cancel()
        deadline = time.monotonic() + _END_S
        for goal in going:
            if goal.thread not in (None, threading.current_thread()):
                goal.thread.join(max(0.0, deadline - time.monotonic()))
        for each in (*self._servers, self._status, self.feedback):
            each.close()

    # --- requests of clients

    def _accept(self, asked: ServiceRequest) -> None:
        """S01: the goal can be canceled on arrival; only after that does this wait for the name of its sender."""
        request = asked.request()
        goal_id = request["goal_id"]["uuid"]
        goal = ReceivedGoal(self, goal_id, request["goal"], asked.came_at)
        refused = None if self._refuse is None else self._refuse(goal.message)
        with self._lock:
            taken = refused is None and not self._closed and goal_id not in self._goals
            before = self._going()
            if taken:
                self._goals[goal_id] = goal
        asked.answer({"accepted": taken, "stamp": stamp(goal.stamp_ns)})
        if taken:
            goal.thread = threading.Thread(
                target=self._pursue, args=(goal, before, asked), name=f"ros2 goal {self._name}", daemon=True
            )
            goal.thread.start()

    def _cancel(self, request: ServiceRequest) -> None:
        info = request.request()["goal_info"]
        goal_id, until_ns = info["goal_id"]["uuid"], _nanoseconds(info["stamp"])
        with self._lock:
            known = self._goals.get(goal_id)
            ending = [goal for goal in self._going() if _meant(goal, goal_id, until_ns)]
            for goal in ending:
                goal.status = Status.CANCELING
        for goal in ending:
            goal.cancel()
        self._tell_status()
        request.answer({"return_code": _refusal(goal_id, known, ending), "goals_canceling": [g.info() for g in ending]})

    def _result(self, request: ServiceRequest) -> None:
        goal_id = request.request()["goal_id"]["uuid"]
        with self._lock:
            goal = self._goals.get(goal_id)
            if goal is not None and goal.outcome is None:
                goal.waiting.append(request)
                return
        request.answer({"status": Status.UNKNOWN} if goal is None else _status_of(goal))

    # --- execution

    def _pursue(self, goal: ReceivedGoal, before: list[ReceivedGoal], request: ServiceRequest) -> None:
        with self._lock:
            goal.status = max(goal.status, Status.EXECUTING)
            for other in before:
                if other.outcome is None:
                    other.status = Status.CANCELING
        for other in before:
            other.cancel()
        self._tell_status()
        goal.of = request.who()
        try:
            self._end(goal, Outcome(GoalEnd.CANCELED, {}) if goal.canceled else self._do(goal))
        except Exception:  # noqa: BLE001 - its client receives the failure
            _log.exception("a goal of %s failed", self._name)
            self._end(goal, Outcome(GoalEnd.ABORTED, {}))

    def _end(self, goal: ReceivedGoal, outcome: Outcome) -> None:
        self._node.types.to_bytes(self._type_name + "_Result", outcome.result)  # raises here, not for each client
        with self._lock:
            goal.outcome, goal.status = outcome, ENDS[outcome.how]
            waiting = list(goal.waiting)
            ended = [each for each in self._goals.values() if each.outcome is not None]
            for old in ended[:-_MOST_ENDED]:
                del self._goals[old.id]
        self._tell_status()
        for asked in waiting:
            asked.answer(_status_of(goal))

    def _going(self) -> list[ReceivedGoal]:
        return [goal for goal in self._goals.values() if goal.outcome is None]

    def _tell_status(self) -> None:
        with self._lock:
            statuses = [{"goal_info": goal.info(), "status": goal.status} for goal in self._goals.values()]
            self._status.send({"status_list": statuses})


def stamp(time_ns: int) -> dict[str, Any]:
    """A ``builtin_interfaces/msg/Time``."""
    return {"sec": time_ns // 1_000_000_000, "nanosec": time_ns % 1_000_000_000}


def _nanoseconds(at: Mapping[str, Any]) -> int:
    return at["sec"] * 1_000_000_000 + at["nanosec"]


def _meant(goal: ReceivedGoal, goal_id: bytes, until_ns: int) -> bool:
    if goal.id == goal_id or (goal_id == ANY and not until_ns):
        return True
    return 0 < goal.stamp_ns <= until_ns


def _refusal(goal_id: bytes, known: ReceivedGoal | None, ending: list[ReceivedGoal]) -> Refusal:
    if ending or goal_id == ANY:
        return Refusal.NONE
    return Refusal.UNKNOWN_GOAL if known is None else Refusal.GOAL_TERMINATED


def _status_of(goal: ReceivedGoal) -> dict[str, Any]:
    return {"status": goal.status, "result": {} if goal.outcome is None else goal.outcome.result}
