"""A ROS 1 action server: five topics, as actionlib specifies.

One goal runs and one waits for its end. A later goal replaces the waiting one and cancels the running one.
Source: "actionlib/DetailedDescription" on wiki.ros.org, also for a cancel without an id or with a time.
As in actionlib's own servers, a goal without a time gets that of its arrival, so that a cancel with a time matches it.
"""

import itertools
import logging
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, Final

from trade.errors import ConfigurationError
from trade_gateway.ros._graph import Goal, GoalEnd, Outcome, Refuse
from trade_gateway.ros.ros1._status import ENDED, Status, Time, day, now
from trade_gateway.ros.ros1._topics import Topics
from trade_gateway.ros.ros1._wire import action_types
from trade_gateway.ros_messages._types import Message

_EVERY_S: Final = 0.2
_KEPT_S: Final = 5.0
"""How long the state of an ended goal, and a cancel whose goal has not arrived, are kept and published."""
_END_S: Final = 2.0
_QUEUE: Final = 100
_MOST: Final = 100
"""Number of goals whose state is published."""
_HOW: Final = {
    GoalEnd.SUCCEEDED: Status.SUCCEEDED,
    GoalEnd.CANCELED: Status.PREEMPTED,
    GoalEnd.ABORTED: Status.ABORTED,
}
_NEVER: Final[Time] = {"sec": 0, "nanosec": 0}
_log: Final = logging.getLogger("trade.ros1")


class _ServedGoal:
    """A received goal. See `Goal`; changed under the server's lock."""

    def __init__(self, server: "ActionServer", goal_id: Message, message: Message, client: str, at: float) -> None:
        self._server = server
        self._callbacks: list[Callable[[], object]] = []
        self._canceled = False
        self.goal_id = goal_id
        self.message = message
        self.client = client
        self.came_at = at
        self.status = Status.PENDING
        self.text = ""
        self.ended_at = 0.0

    def feedback(self, message: Mapping[str, Any]) -> None:
        self._server.feedback(self, message)

    def when_canceled(self, callback: Callable[[], object]) -> None:
        with self._server.lock:
            if not self._canceled:
                self._callbacks.append(callback)
                return
        callback()

    def cancel(self) -> None:
        """Requests its end."""
        with self._server.lock:
            callbacks, self._callbacks, self._canceled = self._callbacks, [], True
            if self.status is Status.ACTIVE:
                self.status = Status.PREEMPTING
        for callback in callbacks:
            try:
                callback()
            except Exception:  # noqa: BLE001 - the callback is the user's
                _log.exception("the cancel of a goal failed")

    @property
    def state(self) -> Message:
        """The state that its client receives."""
        return {"goal_id": self.goal_id, "status": int(self.status), "text": self.text}


class ActionServer:
    """Receives goals and runs them. See the module."""

    def __init__(
        self, graph: Topics, name: str, type_name: str, do: Callable[[Goal], Outcome], refuse: Refuse | None = None
    ) -> None:
        types = action_types(graph.types, type_name)
        self._name = name
        self._do = do
        self._refuse = refuse
        self._numbers = itertools.count(1)
        self._node = graph.node
        self.lock = threading.RLock()
        self._goals: dict[str, _ServedGoal] = {}
        self._early: dict[str, float] = {}
        self._running: _ServedGoal | None = None
        self._waiting: _ServedGoal | None = None
        self._cancels_until = (0, 0)
        self._closed = threading.Event()
        self._idle = threading.Condition(self.lock)
        # a client that connects while a result is on its way, e.g. after a restart of our node, still receives it
        self._result = graph.publish(f"{name}/result", types.result, latched=True, most=_QUEUE)
        self._feedback = graph.publish(f"{name}/feedback", types.feedback, latched=False, most=_QUEUE)
        self._status = graph.publish(f"{name}/status", "actionlib_msgs/msg/GoalStatusArray", latched=True, most=_QUEUE)
        _, cancels = graph.hear(f"{name}/cancel", "actionlib_msgs/msg/GoalID", self._cancel_came, most=_QUEUE)
        # a latched message is not a goal: it may be as old as its publisher
        _, goals = graph.hear(f"{name}/goal", types.goal, self._goal_came, most=_QUEUE, latched=False)
        self._ends = (*cancels, *goals, self._result.close, self._feedback.close, self._status.close)
        threading.Thread(target=self._publish_status, name=f"trade-ros1{name}/status", daemon=True).start()

    def feedback(self, goal: _ServedGoal, message: Mapping[str, Any]) -> None:
        """Sends feedback to the client of a goal."""
        with self.lock:
            state = goal.state
        if goal.status not in ENDED:
            self._feedback.send({"header": {"stamp": now()}, "status": state, "feedback": message})

    def close(self) -> None:
        """Cancels the running goal, waits up to two seconds for its end, and withdraws the action. Idempotent."""
        with self.lock:
            self._closed.set()
            running, waiting, self._waiting = self._running, self._waiting, None
        if waiting is not None:
            self._end(waiting, Status.RECALLED, {}, "the action is withdrawn")
        if running is not None:
            running.cancel()
            with self._idle:
                self._idle.wait_for(lambda: self._running is None, _END_S)
        for end in self._ends:
            end()

    # --- arrival

    def _goal_came(self, message: Message, sender: str, at: float) -> None:
        number = message["goal_id"]["id"] or f"{self._node}-{next(self._numbers)}-{time.time():.9f}"
        sent = _of(message["goal_id"]["stamp"])
        goal_id: Message = {"id": number, "stamp": day(at) if sent == (0, 0) else message["goal_id"]["stamp"]}
        taken = _ServedGoal(self, goal_id, message["goal"], sender, at)
        refused = None if self._refuse is None else self._refuse(taken.message)
        with self.lock:
            if number in self._goals or self._closed.is_set():
                return  # sent twice
            self._goals[number] = taken
            recalled = self._is_recalled(number, sent)
            replaced, before = None, self._running
            if not recalled and refused is None:
                replaced, self._waiting = self._waiting, taken
        if refused is not None:
            self._end(taken, Status.REJECTED, refused.result, refused.text)
            return
        if recalled:
            self._end(taken, Status.RECALLED, {}, "it was canceled before it arrived")
            return
        if replaced is not None:
            self._end(replaced, Status.RECALLED, {}, "another goal replaced it")
        if before is not None:
            before.cancel()
        self._next()

    def _is_recalled(self, number: str, sent: tuple[int, int]) -> bool:
        return self._early.pop(number, None) is not None or (0, 0) < sent <= self._cancels_until

    def _cancel_came(self, message: Message, _: str, __: float) -> None:
        number, until = message["id"], _of(message["stamp"])
        with self.lock:
            self._cancels_until = max(self._cancels_until, until)
            meant = [
                goal for goal in self._goals.values() if goal.status not in ENDED and _is_meant(goal, number, until)
            ]
            if number and number not in self._goals:
                self._early[number] = time.monotonic()
        for goal in meant:
            self._cancel(goal)

    def _cancel(self, goal: _ServedGoal) -> None:
        with self.lock:
            waits = self._waiting is goal
            if waits:
                self._waiting = None
        if waits:
            self._end(goal, Status.RECALLED, {}, "")
        else:
            goal.cancel()
            self._tell()

    # --- execution

    def _next(self) -> None:
        with self.lock:
            if self._running is not None or self._waiting is None:
                return
            self._running, self._waiting = self._waiting, None
            self._running.status = Status.ACTIVE
            run = threading.Thread(target=self._run, args=(self._running,), name=f"trade-ros1{self._name}", daemon=True)
        self._tell()
        run.start()

    def _run(self, goal: _ServedGoal) -> None:
        try:
            outcome = self._do(goal)
            self._end(goal, _HOW[outcome.how], outcome.result, outcome.text)
        except Exception as error:  # noqa: BLE001 - whatever it is, the client must receive a result
            self._end(goal, Status.ABORTED, {}, str(error) or type(error).__name__)
        finally:
            with self._idle:
                self._running = None
                self._idle.notify_all()
            self._next()

    def _end(self, goal: _ServedGoal, status: Status, result: Mapping[str, Any], text: str) -> None:
        state = {"goal_id": goal.goal_id, "status": int(status), "text": text}
        made = {"header": {"stamp": now()}, "status": state, "result": result}
        try:
            self._result.send(made)
        except ConfigurationError as error:
            status, text = Status.ABORTED, f"its result cannot be sent: {error}"
            self._result.send({**made, "status": {**state, "status": int(status), "text": text}, "result": {}})
        with self.lock:
            goal.status, goal.text, goal.ended_at = status, text, time.monotonic()
        self._tell()

    # --- status

    def _publish_status(self) -> None:
        while not self._closed.wait(_EVERY_S):
            self._tell()

    def _tell(self) -> None:
        with self.lock:
            old = time.monotonic() - _KEPT_S
            self._goals = {
                number: goal
                for number, goal in itertools.islice(reversed(self._goals.items()), _MOST)
                if goal.status not in ENDED or goal.ended_at > old
            }
            self._goals = dict(reversed(self._goals.items()))
            self._early = {number: at for number, at in self._early.items() if at > old}
            states = [goal.state for goal in self._goals.values()]
            self._status.send({"header": {"stamp": now()}, "status_list": states})


def _is_meant(goal: _ServedGoal, number: str, until: tuple[int, int]) -> bool:
    """Whether a cancel matches a goal: by its id; by its time, this and all goals before; with neither, always."""
    if not number and until == (0, 0):
        return True
    return goal.goal_id["id"] == number or (0, 0) < _of(goal.goal_id["stamp"]) <= until


def _of(stamp: Message) -> tuple[int, int]:
    return stamp["sec"], stamp["nanosec"]
