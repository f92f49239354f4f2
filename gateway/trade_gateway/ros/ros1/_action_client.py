"""A ROS 1 action client: goals of TRADE at an action of ROS, over five topics as actionlib specifies.

A cancel message may be lost, so an unwanted goal is canceled repeatedly until its server has acknowledged.

Source: "actionlib/DetailedDescription" on wiki.ros.org, and the constants of actionlib_msgs/GoalStatus.
"""

import itertools
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, InvalidStateError
from concurrent.futures import TimeoutError as NotYet
from concurrent.futures import wait as wait_for
from contextlib import suppress
from typing import Any, Final

from trade.errors import ConfigurationError
from trade_gateway.ros._graph import GoalEnd, Outcome, RosRefused, RosUnreachable
from trade_gateway.ros.ros1._status import ENDED, Status, now
from trade_gateway.ros.ros1._topics import Topics
from trade_gateway.ros.ros1._wire import action_types
from trade_gateway.ros_messages._types import Message

_THERE_S: Final = 5.0
"""Timeout for an action to appear at its client's first use."""
_LOOK_S: Final = 0.05
_SILENT_S: Final = 10.0
"""Timeout for a server's status; servers publish it several times a second."""
_RESULT_S: Final = 5.0
"""Time from the final state to the result, as they travel on separate connections."""
_EVERY_S: Final = 0.5
"""Period of the checks of goals, as their servers may be silent."""
_AGAIN_S: Final = 0.2
"""Pause between two cancels of the same goal."""
_END_S: Final = 2.0
"""Time for canceled goals to end while this client closes."""
_MOST: Final = 100
"""Number of unwanted goals that are remembered."""
_QUEUE: Final = 100
_NOT_CANCELED: Final = frozenset({Status.PENDING, Status.ACTIVE})
"""States of a goal whose server has not received a cancel."""
_HOW: Final = {
    Status.SUCCEEDED: GoalEnd.SUCCEEDED,
    Status.PREEMPTED: GoalEnd.CANCELED,
    Status.RECALLED: GoalEnd.CANCELED,
    Status.ABORTED: GoalEnd.ABORTED,
}


class _Goal:
    """A goal that this client sent. See `ActionGoal`."""

    def __init__(self, client: "ActionClient", number: str, feedback: Callable[[Message], object] | None) -> None:
        self._client = client
        self.number = number
        self.feedback = feedback
        self.server = ""
        self.end: Future[Outcome] = Future()
        self.known = False
        self.heard_at = time.monotonic()
        self.ended_at: float | None = None

    def wait(self, timeout_s: float) -> Outcome:
        try:
            return self.end.result(max(timeout_s, 0))
        except NotYet:
            raise self._client.unreachable(f"its end was not received within {timeout_s:.3g} s") from None

    def cancel(self) -> None:
        self._client.cancel(self.number)

    def fail(self, error: Exception) -> None:
        """Ends it without a result."""
        with suppress(InvalidStateError):
            self.end.set_exception(error)

    def give_up(self, problem: str) -> None:
        """Stops following it and cancels it, as it may still run."""
        self.cancel()
        self.fail(self._client.unreachable(problem))


class ActionClient:
    """All goals of TRADE at one action; its topics stay open until `close`."""

    def __init__(self, graph: Topics, name: str, type_name: str) -> None:
        types = action_types(graph.types, type_name)
        self.type_name: Final = type_name
        self._graph = graph
        self._name = name
        self._numbers = itertools.count(1)
        self._lock = threading.Lock()
        self._goals: dict[str, _Goal] = {}
        self._unwanted: dict[str, float] = {}
        self._closing = False
        self._closed = threading.Event()
        self._goal = graph.publish(f"{name}/goal", types.goal, latched=False, most=_QUEUE)
        self._cancel = graph.publish(f"{name}/cancel", "actionlib_msgs/msg/GoalID", latched=False, most=_QUEUE)
        heard = {
            "status": ("actionlib_msgs/msg/GoalStatusArray", self._status),
            "feedback": (types.feedback, self._feedback),
            "result": (types.result, self._result),
        }
        opened = [graph.hear(f"{name}/{topic}", kind, receive, most=_QUEUE) for topic, (kind, receive) in heard.items()]
        self._ends = [self._goal.opened, self._cancel.opened, *(one for one, _ in opened)]
        self._steps = [step for _, steps in opened for step in steps]
        threading.Thread(target=self._look_often, name=f"trade-ros1{name}/goals", daemon=True).start()

    def pursue(self, goal: Mapping[str, Any], feedback: Callable[[Message], object] | None) -> _Goal:
        """Sends a goal. Raises RosUnreachable: no node serves the action."""
        number = f"{self._graph.node}-{next(self._numbers)}-{time.time():.9f}"
        sent = {"header": {"stamp": now()}, "goal_id": {"id": number, "stamp": now()}, "goal": goal}
        pursued = _Goal(self, number, feedback)
        pursued.server = self._server()
        pursued.heard_at = time.monotonic()
        with self._lock:
            if self._closing:
                raise self.unreachable("it was closed here")
            self._goals[number] = pursued
            try:
                self._goal.send(sent)
            except ConfigurationError:
                del self._goals[number]
                raise
        pursued.end.add_done_callback(lambda _: self._goals.pop(number, None))
        return pursued

    def cancel(self, number: str) -> None:
        """Requests the end of a goal, and remembers that it is unwanted."""
        with self._lock:
            self._unwanted[number] = time.monotonic()
            while len(self._unwanted) > _MOST:
                del self._unwanted[next(iter(self._unwanted))]
            self._cancel.send({"id": number})

    def unreachable(self, problem: str) -> RosUnreachable:
        """Returns an error of this action."""
        return RosUnreachable(what=self._name, problem=problem)

    def cancel_all(self) -> None:
        """Accepts no more goals, and requests the end of those that still run."""
        with self._lock:
            self._closing = True
            numbers = list({**self._unwanted, **self._goals})
        for number in numbers:
            self.cancel(number)

    def close(self) -> None:
        """Cancels running goals, waits up to two seconds for their end, and closes. Idempotent."""
        self.cancel_all()
        wait_for([goal.end for goal in self._all()], _END_S)
        self._closed.set()
        for step in (*self._steps, self._goal.close, self._cancel.close):
            step()
        for goal in self._all():
            goal.fail(self.unreachable("it was closed here"))

    def _server(self) -> str:
        """Returns the node that has all five topics."""
        deadline = time.monotonic() + _THERE_S
        while True:
            left_s = deadline - time.monotonic()
            ends = self._graph.connected(self._name, self._ends, max(left_s, 0.5))
            if servers := ends[0].intersection(*ends[1:]):
                return min(servers)
            if left_s <= 0:
                raise self.unreachable("no node serves this action")
            threading.Event().wait(_LOOK_S)

    def _all(self) -> list[_Goal]:
        with self._lock:
            return list(self._goals.values())

    # --- timeouts

    def _look_often(self) -> None:
        while not self._closed.wait(_EVERY_S):
            for goal in self._all():
                self._look(goal)

    def _look(self, goal: _Goal) -> None:
        silent_s = time.monotonic() - goal.heard_at
        if silent_s > _SILENT_S:
            goal.give_up(f"its server {goal.server} has sent no status of it for {_SILENT_S:g} s")
        elif silent_s > _EVERY_S:
            self._cancel_again(goal.number)

    def _cancel_again(self, number: str) -> None:
        """Cancels an unwanted goal again, as the previous cancel may be lost."""
        with self._lock:
            sent_at = self._unwanted.get(number)
        if sent_at is not None and time.monotonic() - sent_at > _AGAIN_S:
            self.cancel(number)

    # --- messages

    def gone(self, name: str) -> None:
        """Handles the end of a node. The end of the bridge's own node is not reported here; it concerns no server."""
        for goal in self._all():
            if goal.server == name:
                goal.give_up(f"its server {name} is gone")

    def _status(self, message: Message, sender: str, at: float) -> None:
        states = {one["goal_id"]["id"]: Status(one["status"]) for one in message["status_list"]}
        for number, state in states.items():
            if state in _NOT_CANCELED:
                self._cancel_again(number)
            elif state in ENDED:
                with self._lock:
                    self._unwanted.pop(number, None)
        for number, goal in self._goals.copy().items():
            if goal.server == sender:
                self._judge(goal, states.get(number), at)

    def _judge(self, goal: _Goal, state: Status | None, at: float) -> None:
        if state is None and goal.known:
            goal.fail(self.unreachable(f"its server {goal.server} does not know it any more"))
        elif state is not None:
            goal.known, goal.heard_at = True, at
            if state in ENDED:
                goal.ended_at = goal.ended_at or at
                if at - goal.ended_at > _RESULT_S:
                    goal.fail(self.unreachable(f"it has ended ({state.name}), but its result was not received"))

    def _feedback(self, message: Message, _: str, __: float) -> None:
        goal = self._goals.get(message["status"]["goal_id"]["id"])
        if goal is not None and goal.feedback is not None:
            goal.feedback(message["feedback"])

    def _result(self, message: Message, _: str, __: float) -> None:
        status = message["status"]
        goal = self._goals.get(status["goal_id"]["id"])
        if goal is None:
            return
        state = Status(status["status"])
        if how := _HOW.get(state):
            with suppress(InvalidStateError):
                goal.end.set_result(Outcome(how, message["result"], status["text"]))
        elif state is Status.REJECTED:
            goal.fail(RosRefused(what=self._name, problem=status["text"] or "the goal was rejected"))
        else:
            goal.fail(self.unreachable(f"its server reports {state.name}: {status['text']}"))
