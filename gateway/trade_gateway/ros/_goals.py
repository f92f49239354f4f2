"""Goals of FollowJointTrajectory as TRADE trajectories, and TRADE errors as its error codes. No input or output.

Fields, units and error codes are those of control_msgs (``FollowJointTrajectory.action``, ``JointTolerance.msg``).
"""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from trade.errors import InvalidArgument, ToleranceExceeded
from trade_gateway.ros_messages._conversion import ros_stamp, seconds
from trade_gateway.ros_messages._joint_names import JointNames
from trade_gateway.ros_messages._types import Message

ACTION: Final = "control_msgs/action/FollowJointTrajectory"
SUCCESSFUL: Final = 0
INVALID_GOAL: Final = -1
INVALID_JOINTS: Final = -2
OLD_HEADER_TIMESTAMP: Final = -3
PATH_TOLERANCE_VIOLATED: Final = -4
GOAL_TOLERANCE_VIOLATED: Final = -5

AT_ONCE_S: Final = 1e-3
"""A first point before this time is rounding of 0, as in `trade_drivers`."""
_CLOCKS_S: Final = 1.0
"""Greatest difference between the clock of a goal's sender and ours."""


class Unacceptable(Exception):
    """A goal that is refused before anything moves."""

    def __init__(self, code: int, problem: str) -> None:
        super().__init__(problem)
        self.code = code
        """The error code of its result, if the type has one."""


def starts_late(goal: Message, now_s: float) -> None:
    """Checks that a goal begins now. Raises Unacceptable: its header says that it began long ago, or begins later."""
    stamp = goal["trajectory"]["header"]["stamp"]
    if not (stamp["sec"] or stamp["nanosec"]):
        return
    late_s = now_s - seconds(stamp)
    if late_s > _CLOCKS_S:
        problem = f"it should have begun {late_s:.3g} s ago. Stamp it 0 to begin at once"
        raise Unacceptable(OLD_HEADER_TIMESTAMP, problem)
    if late_s < -_CLOCKS_S:
        problem = f"it should begin in {-late_s:.3g} s, but goals cannot be scheduled. Stamp it 0 to begin at once"
        raise Unacceptable(INVALID_GOAL, problem)


def trajectory_of(goal: Message, names: JointNames, here: Mapping[str, float] | None) -> dict[str, Any]:
    """Converts a goal's trajectory to one of TRADE.

    Args:
        goal: the whole goal.
        names: the joints' names.
        here: the current angles, by TRADE name, prepended if the first point is later than `AT_ONCE_S`. None: it must
            be at 0 s.

    Raises:
        Unacceptable: it has other joints, or points without angles.
    """
    joint_names: Sequence[str] = goal["trajectory"]["joint_names"]
    if sorted(joint_names) != sorted(names.trade_names):
        given = ", ".join(joint_names) or "no joints"
        problem = f"it is for {given}, but must include exactly {', '.join(names.trade_names)}"
        raise Unacceptable(INVALID_JOINTS, problem)
    if goal.get("multi_dof_trajectory", {}).get("points"):
        raise Unacceptable(INVALID_GOAL, "multi_dof_trajectory has points, but only joints of one axis are supported")
    points = [_point(point, joint_names) for point in goal["trajectory"]["points"]]
    if not points:
        raise Unacceptable(INVALID_GOAL, "it has no points. To stop, cancel a goal or call the stop service")
    joints = [names.trade_names[name] for name in joint_names]
    if points[0]["time_from_start_s"] >= AT_ONCE_S:
        if here is None:
            raise Unacceptable(INVALID_GOAL, "its first point must be at 0 s")
        first: dict[str, Any] = {"time_from_start_s": 0.0, "positions_rad": [here[joint] for joint in joints]}
        first |= {
            field: [0.0] * len(joints) for field in ("velocities_rad_s", "accelerations_rad_s2") if field in points[0]
        }
        points.insert(0, first)
    return {"joints": joints, "points": points}


def _point(point: Message, names: Sequence[str]) -> dict[str, Any]:
    for field in ("positions", "velocities", "accelerations"):
        if len(point[field]) not in ((len(names),) if field == "positions" else (0, len(names))):
            problem = f"a point has {len(point[field])} {field} for {len(names)} joints"
            raise Unacceptable(INVALID_GOAL, problem)
    plain: dict[str, Any] = {
        "time_from_start_s": seconds(point["time_from_start"]),
        "positions_rad": point["positions"],
    }
    if point["velocities"]:
        plain["velocities_rad_s"] = point["velocities"]
    if point["accelerations"]:
        plain["accelerations_rad_s2"] = point["accelerations"]
    return plain


def lasts_s(trajectory: Mapping[str, Any]) -> float:
    """Duration of a TRADE trajectory, in seconds."""
    return trajectory["points"][-1]["time_from_start_s"]


def tolerances_of(goal: Message) -> dict[str, float]:
    """Tolerances in TRADE's terms: the tightest of a goal applies to all; those it omits are default.

    Tolerances of speed and acceleration are ignored, and none can be disabled (-1).
    """
    tolerances: dict[str, float] = {}
    for name, field in (("path_rad", "path_tolerance"), ("goal_rad", "goal_tolerance")):
        if bounds := [one["position"] for one in goal[field] if one["position"] > 0]:
            tolerances[name] = min(bounds)
    if (time_s := seconds(goal["goal_time_tolerance"])) > 0:
        tolerances["goal_time_s"] = time_s
    return tolerances


def code_of(error: BaseException) -> int:
    """The error code that describes an error best; the text beside it has the details."""
    if isinstance(error, Unacceptable):
        return error.code
    if isinstance(error, ToleranceExceeded):
        return {"path": PATH_TOLERANCE_VIOLATED, "goal": GOAL_TOLERANCE_VIOLATED}.get(error.what, INVALID_GOAL)
    if isinstance(error, InvalidArgument) and error.argument == "trajectory.joints":
        return INVALID_JOINTS
    return INVALID_GOAL


def goal_of(joints: Sequence[str], points: Sequence[Mapping[str, Any]]) -> Message:
    """Builds a goal for joints of ROS.

    Args:
        joints: their names.
        points: as in TRADE trajectories, in the order of the joints.
    """
    return {
        "trajectory": {
            "joint_names": list(joints),
            "points": [
                {
                    "positions": list(point["positions_rad"]),
                    "velocities": list(point.get("velocities_rad_s") or ()),
                    "accelerations": list(point.get("accelerations_rad_s2") or ()),
                    "time_from_start": ros_stamp(point["time_from_start_s"]),
                }
                for point in points
            ],
        }
    }
