"""Goals that TRADE sends to an action of ROS: a later one replaces the one before, and a stop cancels it."""

import threading
from collections.abc import Callable, Sequence
from typing import Any, Final

from trade import Permit, Resource, current_call, permit
from trade.errors import DeviceFault, MotionStopped
from trade_gateway.ros._graph import ActionGoal, GoalEnd, Graph, Outcome, RosRefused, RosUnreachable
from trade_gateway.ros_messages._types import Message

_STOPPED_WITHIN_S: Final = 1.8
"""Within the time that the end of a session allows (S05)."""
_LONGEST_S: Final = 3600.0
TEXTS: Final = ("error_string", "error_msg", "message")
"""Fields of results that say what failed."""


class SentGoals:
    """The goals of one action.

    Args:
        graph: sends them.
        action: its name in ROS.
        type_name: its type.
        device: what it moves, for errors.
        resources: the same for locks; none: it moves nothing.
    """

    def __init__(
        self, graph: Graph, action: str, type_name: str, device: str, resources: Sequence[Resource] = ()
    ) -> None:
        self._graph = graph
        self._action = action
        self._type_name = type_name
        self._device = device
        self._resources: Final = tuple(resources)
        self._guard = threading.Condition()
        self._active: ActionGoal | None = None
        self._sending = 0
        """Goals that are being sent to the action."""
        self._stops = 0

    def carry_out(self, goal: Message, reported: Callable[[Message], Any]) -> Outcome:
        """Sends a goal and waits for its end, in a service: its call's cancellation and deadline cancel the goal.

        Args:
            goal: the message.
            reported: makes the progress of the call from feedback.

        Raises:
            RosUnreachable: no node serves the action.
            RosRefused: the goal was rejected.
            DeviceFault: the goal was aborted, or whether it has ended is unknown.
            MotionStopped: it was canceled, or the deadline has expired.
        """
        with permit(self._resources) as permitted:
            before = self._active
            if before is not None:  # our own: another move replaces it, and its caller waits for its end
                before.cancel()
            outcome = self._ended(self._sent(goal, permitted, reported))
        if outcome.how is GoalEnd.CANCELED:
            raise MotionStopped(device=self._device, reason=text_of(outcome) or "its goal was canceled")
        if outcome.how is GoalEnd.ABORTED:
            raise self.fault(outcome)
        return outcome

    def fault(self, outcome: Outcome) -> DeviceFault:
        """The error of a goal that failed."""
        code = outcome.result.get("error_code", 0)
        detail = f" (error code {code})" if isinstance(code, int) and code else ""
        fault = f"{text_of(outcome) or 'its goal was aborted'}{detail}"
        return DeviceFault(device=self._device, bus=self._action, fault=fault)

    def stop(self) -> None:
        """Cancels the goals that were sent to the action; goals of other ROS nodes continue.

        Raises:
            DeviceFault: their end was not confirmed.
        """
        with self._guard:
            self._stops += 1
            active = self._active
        if active is not None:
            self._cancel(active)
            self._rest(active)
        with self._guard:
            if not self._guard.wait_for(lambda: not self._sending, _STOPPED_WITHIN_S):
                fault = "a goal is being sent to it; it is canceled as soon as it has arrived"
                raise DeviceFault(device=self._device, bus=self._action, fault=fault)

    def _cancel(self, pursuit: ActionGoal) -> None:
        """Raises DeviceFault: its end was not confirmed, so it counts as moving."""
        pursuit.cancel()
        try:
            pursuit.wait(_STOPPED_WITHIN_S)
        except RosRefused:  # it never began
            return
        except RosUnreachable as silent:
            fault = f"canceled, but its end was not confirmed: {silent}"
            raise DeviceFault(device=self._device, bus=self._action, fault=fault) from None

    def _sent(self, goal: Message, permitted: Permit, reported: Callable[[Message], Any]) -> ActionGoal:
        """Sends a goal. A stop does not wait for this: it cancels the goal as soon as the goal has arrived."""
        call = current_call()

        def report(message: Message) -> None:
            if call is not None:
                call.progress(reported(message))

        with self._guard:
            permitted.gate()
            stops, self._sending = self._stops, self._sending + 1
            for resource in self._resources:
                resource.moving = True
        rests = True
        try:
            pursuit = self._graph.pursue(self._action, self._type_name, goal, report)
            rests = False
            with self._guard:
                overtaken = self._stops != stops
                self._active = self._active if overtaken else pursuit
            if not overtaken:
                return pursuit
            self._cancel(pursuit)
            rests = True
        finally:
            self._arrived(rests=rests)
        raise MotionStopped(device=self._device, reason="it was stopped before its goal had arrived")

    def _arrived(self, *, rests: bool) -> None:
        with self._guard:
            self._sending -= 1
            if rests and not self._sending and self._active is None:
                for resource in self._resources:
                    resource.moving = False
            self._guard.notify_all()

    def _ended(self, pursuit: ActionGoal) -> Outcome:
        call = current_call()
        if call is not None:
            call.on_cancel(pursuit.cancel)
        try:
            outcome = pursuit.wait(_LONGEST_S if call is None else call.patience_s(_LONGEST_S))
        except RosRefused:
            self._rest(pursuit)
            raise
        except RosUnreachable as silent:
            self._cancel(pursuit)
            self._rest(pursuit)
            raise MotionStopped(device=self._device, reason=f"its goal was canceled: {silent}") from None
        self._rest(pursuit)
        return outcome

    def _rest(self, pursuit: ActionGoal) -> None:
        with self._guard:
            if self._active is pursuit:
                self._active = None
                for resource in self._resources:
                    resource.moving = False


def text_of(outcome: Outcome) -> str:
    """What its server says about a goal."""
    texts = (outcome.result.get(name) for name in TEXTS)
    return outcome.text or next((text for text in texts if isinstance(text, str) and text), "")
