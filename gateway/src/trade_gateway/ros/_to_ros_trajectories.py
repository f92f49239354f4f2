"""Joints and arms of TRADE as a FollowJointTrajectory action, which MoveIt and others use to move robots."""

import logging
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from typing import Any, Final

import msgspec

from trade import Constraint, Container, Handle, Run, where
from trade.errors import SessionEnded
from trade_gateway.ros._conversion import ros_stamp
from trade_gateway.ros._file import TrajectoryEntry
from trade_gateway.ros._goals import (
    ACTION,
    INVALID_GOAL,
    SUCCESSFUL,
    Unacceptable,
    code_of,
    lasts_s,
    starts_late,
    text_of,
    tolerances_of,
    trajectory_of,
)
from trade_gateway.ros._graph import Closes, Ended, Goal, Graph, Outcome
from trade_gateway.ros._joints import LIMBS, JointNames, beside, joints_of, limbs, measured
from trade_gateway.ros._mapping_sync import Place
from trade_gateway.ros._nodes import Nodes

__all__ = ["TrajectoriesToRos"]

_logger = logging.getLogger("trade")

_MORE_S: Final = 15.0
"""Time of a call beyond the duration of its trajectory."""
_READ_WITHIN_S: Final = 2.0
_WAIT_S: Final = 2.0
"""Wait for a lock: the time in which a joint comes to rest."""
_TURN_WITHIN_S: Final = 5.0
_LATE_S: Final = 5.0


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

    def places(self, found: Sequence[Handle]) -> Iterable[tuple[Place, Handle]]:
        for handle in limbs(found, self._entry.group, "follow"):
            yield Place("action", self._entry.action), handle

    def open(self, place: Place, handle: Handle) -> Closes:
        entry = self._entry
        joints = joints_of(self._container, handle)
        names = JointNames(joints, short=entry.names == "last", named=entry.joints)
        limb = _Limb(handle, beside(self._container, handle, "state"), names, self._nodes)
        return self._graph.act(place.name, ACTION, limb.pursue)


class _Limb:
    """Executes goals, one at a time."""

    def __init__(self, follow: Handle, state: Handle, names: JointNames, nodes: Nodes) -> None:
        self._follow = follow
        self._state = state
        self._names = names
        self._nodes = nodes
        self._turn = threading.Lock()

    def pursue(self, goal: Goal) -> Outcome:
        """Executes a goal to its end. Its result contains any error."""
        canceling = _Canceling(goal)
        # the previous goal was canceled, and its stop must not stop this one
        if not self._turn.acquire(timeout=_TURN_WITHIN_S):
            return _outcome(Ended.ABORTED, INVALID_GOAL, "the goal before it does not end")
        try:
            return self._carried_out(goal, canceling)
        finally:
            self._turn.release()

    def _carried_out(self, goal: Goal, canceling: "_Canceling") -> Outcome:
        try:
            starts_late(goal.message, time.time())
            guest = self._nodes.guest(goal.client, goal.came_at)
            trajectory = trajectory_of(goal.message, self._names, self._here(goal))
            args = {"trajectory": trajectory, "tolerances": tolerances_of(goal.message)}
            deadline_s = lasts_s(trajectory) + _MORE_S
            purpose = f"a trajectory of {guest.named}"
            with ExitStack() as held:
                admitted = guest.client.admit(self._follow)
                held.enter_context(guest.grips.hold([self._follow], purpose, _WAIT_S))
                if canceling.asked:
                    return _outcome(Ended.CANCELED, SUCCESSFUL, "canceled before it began")
                run = guest.begin(self._follow, args, deadline_s, goal.came_at, admitted)
                run.on_progress(lambda progress: _try(lambda: self._tell(goal, progress)))
                canceling.ends(lambda: guest.client.cancel(run))
                _wait(run, deadline_s, canceling)
        except Exception as error:  # noqa: BLE001 - reported to its client, whatever it is
            if canceling.asked and not isinstance(error, Unacceptable):
                return _outcome(Ended.CANCELED, SUCCESSFUL, text_of(error))
            return _outcome(Ended.ABORTED, code_of(error), text_of(error))
        return _outcome(Ended.SUCCEEDED, SUCCESSFUL, "")

    def _here(self, goal: Goal) -> dict[str, float] | None:
        """The current angles, unless the goal says where the joints begin."""
        points = goal.message["trajectory"]["points"]
        if not points or points[0]["time_from_start"] == {"sec": 0, "nanosec": 0}:
            return None
        now = measured(list(self._names.trade_names.values()), self._state.with_(deadline_s=_READ_WITHIN_S)())
        return dict(zip(now.names, now.positions_rad, strict=True))

    def _tell(self, goal: Goal, progress: object) -> None:
        plain: Any = msgspec.to_builtins(progress)
        errors: list[float] = plain["errors_rad"]
        goal.feedback(
            {
                "header": {"stamp": ros_stamp(time.time())},
                "joint_names": self._names.ros_names,
                "error": {"positions": [-error for error in errors]},  # in ROS: desired minus actual
            }
        )


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


def _wait(run: Run, deadline_s: float, canceling: _Canceling) -> None:
    try:
        run.result(deadline_s + _LATE_S)
    finally:
        if not run.done():
            canceling.ask()


def _outcome(how: Ended, code: int, text: str) -> Outcome:
    return Outcome(how, {"error_code": code, "error_string": text}, text)
