"""Goals that nodes of ROS send to an action of TRADE: each becomes a call of a service, one at a time, under a lock."""

import logging
import threading
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, Final, NamedTuple, Protocol

from trade import Handle, Run
from trade.errors import SessionEnded
from trade_gateway.ros._goals import Unacceptable
from trade_gateway.ros._graph import Goal, GoalEnd, Outcome
from trade_gateway.ros._nodes import Nodes
from trade_gateway.ros_messages._conversion import failure
from trade_gateway.ros_messages._types import Message

_logger = logging.getLogger("trade")

_WAIT_S: Final = 2.0
"""Wait for a lock: the time in which a joint comes to rest."""
_TURN_WITHIN_S: Final = 5.0
_LATE_S: Final = 5.0


class CallOfGoal(NamedTuple):
    """The call that carries a goal out."""

    args: dict[str, Any]
    """By name."""
    deadline_s: float


class ActionMeaning(Protocol):
    """What the goals, the feedback and the results of an action mean."""

    @property
    def purpose(self) -> str:
        """The purpose of the lock, without the name of the node: ``a trajectory``."""
        ...

    def check(self, message: Message) -> None:
        """Raises Unacceptable: no robot in any state could carry this goal out."""
        ...

    def call_of(self, goal: Goal) -> CallOfGoal:
        """The call for a goal. Raises Unacceptable, or what a look at the robot raises."""
        ...

    def feedback_of(self, progress: Any) -> Message | None:
        """The feedback for progress of the call; None: it has none."""
        ...

    def result_of(self, how: GoalEnd, value: Any, error: BaseException | None) -> Message:
        """The result for what the call returned, or for the reason why it did not."""
        ...


class ServedGoals:
    """Carries out the goals of one action.

    Args:
        handle: the service that carries them out.
        nodes: the clients of ROS.
        meaning: of the action.
    """

    def __init__(self, handle: Handle, nodes: Nodes, meaning: ActionMeaning) -> None:
        self._handle = handle
        self._nodes = nodes
        self._meaning = meaning
        self._turn = threading.Lock()
        self._refused = ""
        """The reason of the last rejection."""

    def refuse(self, message: Message) -> Outcome | None:
        """See `Refuse`."""
        try:
            self._meaning.check(message)
        except Unacceptable as why:
            if str(why) != self._refused:  # a node may send the same goal again and again
                _logger.warning("a goal for %s is rejected: %s", self._handle.label, why)
            self._refused = str(why)
            return self._outcome(GoalEnd.ABORTED, why)
        return None

    def carry_out(self, goal: Goal) -> Outcome:
        """Carries out a goal to its end. Its result contains any error."""
        canceling = _Canceling(goal)
        # the previous goal was canceled, and its stop must not stop this one
        if not self._turn.acquire(timeout=_TURN_WITHIN_S):
            return self._outcome(GoalEnd.ABORTED, Unacceptable(-1, "the goal before it does not end"))
        try:
            return self._carried_out(goal, canceling)
        finally:
            self._turn.release()

    def _carried_out(self, goal: Goal, canceling: "_Canceling") -> Outcome:
        handle = self._handle
        try:
            guest = self._nodes.guest(goal.client, goal.came_at)
            args, deadline_s = self._meaning.call_of(goal)
            with ExitStack() as held:
                admitted = guest.client.admit(handle)
                if handle.effect == "actuate":
                    purpose = f"{self._meaning.purpose} of {guest.named}"
                    held.enter_context(guest.grips.hold([handle], purpose, _WAIT_S))
                if canceling.asked:
                    return self._outcome(GoalEnd.CANCELED, Unacceptable(0, "canceled before it began"))
                run = guest.begin(handle, args, deadline_s, goal.came_at, admitted)
                run.on_progress(lambda progress: _try(lambda: self._tell(goal, progress)))
                canceling.ends(lambda: guest.client.cancel(run))
                value = _result(run, deadline_s, canceling)
            return Outcome(GoalEnd.SUCCEEDED, self._meaning.result_of(GoalEnd.SUCCEEDED, value, None))
        except Exception as error:  # noqa: BLE001 - reported to its client, whatever it is
            canceled = canceling.asked and not isinstance(error, Unacceptable)
            return self._outcome(GoalEnd.CANCELED if canceled else GoalEnd.ABORTED, error)

    def _outcome(self, how: GoalEnd, error: BaseException) -> Outcome:
        return Outcome(how, self._meaning.result_of(how, None, error), text_of(error))

    def _tell(self, goal: Goal, progress: object) -> None:
        if (feedback := self._meaning.feedback_of(progress)) is not None:
            goal.feedback(feedback)


class _Canceling:
    """Whether the client canceled a goal, and the callback for that."""

    def __init__(self, goal: Goal) -> None:
        self.asked = False
        self._guard = threading.Lock()
        self._end: Callable[[], object] = lambda: None
        goal.when_canceled(self.ask)

    def ask(self) -> None:
        """Cancels the goal."""
        with self._guard:
            self.asked, end = True, self._end
        _try(end)

    def ends(self, end: Callable[[], object]) -> None:
        """Registers the callback that cancels; it runs at once if the goal is canceled already."""
        with self._guard:
            self._end, now = end, self.asked
        if now:
            _try(end)


def _try(end: Callable[[], object]) -> None:
    try:
        end()
    except SessionEnded:  # it has ended, and its motion too
        pass
    except Exception:
        _logger.exception("the feedback or the cancellation of a goal failed")


def _result(run: Run, deadline_s: float, canceling: _Canceling) -> Any:
    try:
        return run.result(deadline_s + _LATE_S)
    finally:
        if not run.done():
            canceling.ask()


def text_of(error: BaseException) -> str:
    """The text of an error, for the client."""
    return str(error) if isinstance(error, Unacceptable) else failure(error)
