"""What the client and the server of a ROS 2 action share.

Facts, from the design article *Actions* of ROS 2 (design.ros2.org) and ``action_msgs``: an action ``/name`` is the
services ``/name/_action/send_goal``, ``cancel_goal``, ``get_result`` and the topics ``feedback`` and ``status``, the
last one latched. The client names a goal by 16 random bytes. ``get_result`` is answered when the goal has ended.
A request to cancel names a goal, or a time up to which all were accepted, or neither, which means all goals.
"""

from enum import IntEnum
from typing import Any, Final

from trade_gateway.ros._graph import GoalEnd

CANCEL: Final = "action_msgs/srv/CancelGoal"
STATUS: Final = "action_msgs/msg/GoalStatusArray"
ANY: Final = bytes(16)


class Status(IntEnum):
    """State of a goal: ``action_msgs/msg/GoalStatus``."""

    UNKNOWN = 0
    ACCEPTED = 1
    EXECUTING = 2
    CANCELING = 3
    SUCCEEDED = 4
    CANCELED = 5
    ABORTED = 6


class Refusal(IntEnum):
    """Return code of a cancel request: ``action_msgs/srv/CancelGoal``."""

    NONE = 0
    REJECTED = 1
    UNKNOWN_GOAL = 2
    GOAL_TERMINATED = 3


ENDS: Final = {GoalEnd.SUCCEEDED: Status.SUCCEEDED, GoalEnd.CANCELED: Status.CANCELED, GoalEnd.ABORTED: Status.ABORTED}


def uuid(goal_id: bytes) -> dict[str, Any]:
    """A ``unique_identifier_msgs/msg/UUID``."""
    return {"uuid": goal_id}
