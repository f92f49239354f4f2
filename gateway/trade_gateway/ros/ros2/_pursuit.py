"""A ROS 2 action client: one goal of the bridge at an action of ROS."""

import contextlib
import secrets
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, Final

from trade_gateway.ros._graph import GoalEnd, Outcome, RosRefused, RosUnreachable
from trade_gateway.ros.ros2._action import CANCEL, ENDS, Refusal, uuid
from trade_gateway.ros.ros2._names import TokenKind
from trade_gateway.ros.ros2._node import Node
from trade_gateway.ros.ros2._services import Client, Unanswered
from trade_gateway.ros.ros2._topics import TopicSubscription
from trade_gateway.ros_messages._types import Message

_ACCEPT_S: Final = 5.0
_CANCEL_S: Final = 5.0
_ASK_S: Final = 30.0
"""Timeout of one request for the result; another follows it. ROS 2 itself asks once, without a deadline."""
_ABANDON_S: Final = 10.0
"""How long an abandoned goal that may still run is canceled again and again."""
_GONE_S: Final = 3.0
"""How long a server may be invisible before it counts as gone: the router may return in that time."""
_AGAIN_S: Final = 0.2
_END_S: Final = 2.0

_HOW: Final = {int(status): how for how, status in ENDS.items()}


class Ros2ActionGoal:
    """A sent goal. Its own thread requests the result until it is known."""

    def __init__(self, node: Node, name: str, type_name: str, feedback: Callable[[Message], object] | None) -> None:
        """Raises ConfigurationError: the name or type is invalid."""
        node.hashes.learn_action(type_name)
        self._node = node
        self._name = name
        self._id = secrets.token_bytes(16)
        self._this: Final = {"goal_info": {"goal_id": uuid(self._id)}}
        self._feedback = feedback
        self._unwanted = False
        self._over = threading.Event()
        self._closed = threading.Event()
        self._outcome: Outcome | RosRefused | RosUnreachable | None = None
        start = f"{name}/_action"
        self._send = Client(node, f"{start}/send_goal", f"{type_name}_SendGoal")
        self._get = Client(node, f"{start}/get_result", f"{type_name}_GetResult")
        self._stop = Client(node, f"{start}/cancel_goal", CANCEL)
        self._hearing = (
            None
            if feedback is None
            else TopicSubscription(
                node, f"{start}/feedback", f"{type_name}_FeedbackMessage", self._heard, latched=False
            )
        )
        self._thread = threading.Thread(target=self._follow, name=f"ros2 pursuit {name}", daemon=True)

    def begin(self, goal: Mapping[str, Any]) -> None:
        """Sends the goal. If its outcome is unknown, the goal is canceled and counts as running until it ends.

        Raises:
            RosUnreachable: no node serves the action, so the goal was not sent.
            ConfigurationError: the goal does not fit.
        """
        try:
            answer = self._send.ask({"goal_id": uuid(self._id), "goal": goal}, _ACCEPT_S)
        except RosRefused as refused:
            self._finish(refused)
            return
        except BaseException:
            self._finish(RosUnreachable(what=self._name, problem="the goal was not sent"))
            raise
        if isinstance(answer, Unanswered):
            unheard = RosUnreachable(what=self._name, problem=answer.problem)
            if not answer.sent and not self._is_present():
                self._finish(unheard)
                raise unheard
            self._abandon(unheard)
        elif answer["accepted"]:
            self._thread.start()
        else:
            self._finish(RosRefused(what=self._name, problem="the goal was rejected"))

    def wait(self, timeout_s: float) -> Outcome:
        """See `ActionGoal`."""
        self._over.wait(timeout_s)
        match self._outcome:
            case Outcome() as outcome:
                return outcome
            case None:
                raise RosUnreachable(what=self._name, problem=f"the goal has not ended within {timeout_s:g} s")
            case failure:
                raise failure

    def cancel(self) -> None:
        """See `ActionGoal`. Without a router, the request is repeated once there is one."""
        self._unwanted = True
        if not self._over.is_set():
            with contextlib.suppress(RosUnreachable):
                self._stop.send(self._this, _CANCEL_S)

    def close(self) -> None:
        """Cancels the goal and stops following it. Idempotent."""
        self._closed.set()
        if not self._over.is_set():
            with contextlib.suppress(RosUnreachable, RosRefused):
                self._stop.call(self._this, _END_S)
            self._finish(RosUnreachable(what=self._name, problem="the bridge to ROS was closed; the goal was canceled"))

    def _follow(self) -> None:
        last_seen = time.monotonic()
        while not self._over.is_set():
            if self._unwanted:
                self.cancel()
            try:
                answer = self._get.call({"goal_id": uuid(self._id)}, _ASK_S)
            except RosUnreachable as unreachable:
                if self._node.presence.offered(TokenKind.SERVER, self._get.name):
                    last_seen = time.monotonic()
                elif time.monotonic() - last_seen > _GONE_S:
                    self._gone(f"its server is gone: {unreachable.problem}")
            except RosRefused as refused:
                self._finish(refused)
            else:
                self._finish(self._read(answer))
            self._over.wait(_AGAIN_S)

    def _is_present(self) -> bool:
        """Whether a node serves the action after all; if so, this cancels the goal."""
        try:
            answer = self._stop.ask(self._this, _END_S)
        except RosRefused:
            return True
        return not isinstance(answer, Unanswered) or answer.sent

    def _gone(self, problem: str) -> None:
        if not self._over.is_set():
            self._outcome = why = RosUnreachable(what=self._name, problem=problem)
            self._over.set()
            self._abandon(why)

    def _abandon(self, reason: RosUnreachable) -> None:
        """S05: the goal may still run, so this cancels it repeatedly for some time."""
        threading.Thread(target=self._end, args=(reason,), name=f"ros2 end {self._name}", daemon=True).start()

    def _end(self, reason: RosUnreachable) -> None:
        deadline = time.monotonic() + _ABANDON_S
        canceled, ended = False, False
        while not ended and time.monotonic() < deadline and not self._closed.is_set():
            refusal = None if canceled else self._cancel_once()
            canceled = canceled or refusal is Refusal.NONE
            ended = refusal is Refusal.GOAL_TERMINATED or (canceled and self._has_ended(deadline - time.monotonic()))
            if not ended:
                self._closed.wait(_AGAIN_S)
        problem = f"{reason.problem}; {_end_of(canceled=canceled, ended=ended)}"
        self._finish(RosUnreachable(what=self._name, problem=problem))

    def _cancel_once(self) -> Refusal | None:
        with contextlib.suppress(RosUnreachable, RosRefused, ValueError):
            return Refusal(self._stop.call(self._this, _END_S)["return_code"])
        return None

    def _has_ended(self, timeout_s: float) -> bool:
        with contextlib.suppress(RosUnreachable, RosRefused):
            return self._get.call({"goal_id": uuid(self._id)}, max(_AGAIN_S, timeout_s))["status"] in _HOW
        return False

    def _read(self, answer: Message) -> Outcome | RosUnreachable:
        how: GoalEnd | None = _HOW.get(answer["status"])
        if how is None:
            problem = "its server does not know the goal any more; has the server restarted?"
            return RosUnreachable(what=self._name, problem=problem)
        return Outcome(how, answer["result"])

    def _heard(self, message: Message, _who: str) -> None:
        if self._feedback is not None and message["goal_id"]["uuid"] == self._id and not self._over.is_set():
            self._feedback(message["feedback"])

    def _finish(self, outcome: Outcome | RosRefused | RosUnreachable) -> None:
        if self._outcome is None:
            self._outcome = outcome
        self._over.set()
        for each in (self._hearing, self._send, self._get, self._stop):
            if each is not None:
                each.close()


def _end_of(*, canceled: bool, ended: bool) -> str:
    if ended:
        return "it was canceled, and has ended"
    if canceled:
        return "it was canceled, but whether it has ended is unknown"
    return "it could not be canceled, and whether it has ended is unknown"
