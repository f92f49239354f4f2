"""Names and checksums of ROS 1 types, by which both ends check that their definitions match.

Sources: "ROS/TCPROS" (fields of the connection header) and "ROS/Technical Overview" (MD5 sums: comments gone,
constants first, the types of other messages replaced by their sums) on wiki.ros.org; "actionlib/DetailedDescription"
(the messages around goal, feedback and result).
"""

from hashlib import md5
from typing import Final, NamedTuple

from rosbags.interfaces import Nodetype

from trade_gateway.ros.ros1._node._frames import Head
from trade_gateway.ros_messages._types import Types

_RULE: Final = "=" * 80
_AROUND: Final = {
    "Goal": ("goal", "goal_id", "actionlib_msgs/msg/GoalID"),
    "Result": ("result", "status", "actionlib_msgs/msg/GoalStatus"),
    "Feedback": ("feedback", "status", "actionlib_msgs/msg/GoalStatus"),
}
"""For each part of an action: its field in the surrounding message, and the field beside it."""


class ActionTypes(NamedTuple):
    """The messages of an action's topics."""

    goal: str
    result: str
    feedback: str


def message_head(types: Types, type_name: str) -> Head:
    """The description of a message type in a frame. Raises ConfigurationError: the type is not known."""
    text, checked = types.definition(type_name)
    return {"type": _plain(type_name), "md5": checked, "text": text}


def service_head(types: Types, type_name: str) -> Head:
    """The description of a service type in a frame. Raises ConfigurationError: the type is not known."""
    parts = types.parts(type_name)
    request, response = (message_head(types, part) for part in parts)
    checked = md5("".join(_checked_text(types, part) for part in parts).encode(), usedforsecurity=False).hexdigest()
    return {"type": _plain(type_name), "md5": checked, "request": request, "response": response}


def action_types(types: Types, type_name: str) -> ActionTypes:
    """Names of the messages around goal, result and feedback. Raises ConfigurationError: the type is not known."""
    package, _, action = type_name.split("/")
    made: list[str] = []
    for part, (suffix, (field, beside, beside_type)) in zip(types.parts(type_name), _AROUND.items(), strict=True):
        inner, outer = f"{package}/msg/{action}{suffix}", f"{package}/msg/{action}Action{suffix}"
        fields = {"header": "std_msgs/msg/Header", beside: beside_type, field: inner}
        types._store.register({inner: types._store.fielddefs[part]})
        types._store.register({outer: ([], [(name, (Nodetype.NAME, kind)) for name, kind in fields.items()])})
        made.append(outer)
    return ActionTypes(*made)


def _plain(type_name: str) -> str:
    """``std_srvs/srv/Trigger_Request`` is ``std_srvs/TriggerRequest`` in ROS 1."""
    package, kind, name = type_name.split("/")
    return f"{package}/{name}" if kind == "msg" else f"{package}/{name.replace('_', '')}"


def _checked_text(types: Types, type_name: str) -> str:
    """Returns the text that the MD5 sum covers."""
    own, _, _ = types.definition(type_name)[0].partition(_RULE)
    return "\n".join(_checked_line(types, line) for line in own.splitlines()).strip()


def _checked_line(types: Types, line: str) -> str:
    kind, _, rest = line.partition(" ")
    if "/" not in kind:
        return line
    package, name = kind.partition("[")[0].split("/")
    return f"{types.definition(f'{package}/msg/{name}')[1]} {rest}"
