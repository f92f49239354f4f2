"""Type hashes of ROS 2 (RIHS01), also for services and the parts of actions.

Facts: REP 2011 and 2016 (the hash covers the description of the type and of all types in it), and the additions of
adds (``rosidl_parser/definition.py``, ``rosidl_generator_type_description``):

- A service is described as a type with the fields ``request_message``, ``response_message``, ``event_message``; its
  event has ``info`` (``service_msgs/msg/ServiceEventInfo``), ``request`` and ``response``, at most one of each.
- An action ``Name`` has the services ``Name_SendGoal`` (goal id and goal; accepted and stamp) and ``Name_GetResult``
  (goal id; status and result), and the message ``Name_FeedbackMessage`` (goal id and feedback).
- ``char`` is an unsigned number of 8 bits. rosbags takes it for a character of IDL, which gives wrong hashes to all
  services, as their events contain one; this module corrects that.
"""

import threading
from typing import Any, Final

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

from trade.errors import ConfigurationError
from trade_gateway.ros_messages._types import Types

_UUID: Final = ("goal_id", (Nodetype.NAME, "unique_identifier_msgs/msg/UUID"))
_EVENT_INFO: Final = "service_msgs/msg/ServiceEventInfo"

Described = tuple[str, Any]
"""A field: its name, and its kind in the notation of rosbags."""


class Hashes:
    """Hashes of the types of one graph. It also adds the parts of actions that ROS generates to the graph's types."""

    def __init__(self, types: Types) -> None:
        self._types = types
        self._described = get_typestore(Stores.EMPTY)
        self._lock = threading.Lock()

    def message(self, type_name: str) -> str:
        """Returns the hash of a message. Raises ConfigurationError: the message or a type in it is not known."""
        with self._lock:
            self._describe(type_name)
            return self._described.hash_rihs01(type_name)

    def service(self, type_name: str) -> str:
        """Returns the hash of a service, also of one of an action. Raises ConfigurationError: it is not known."""
        request, response = f"{type_name}_Request", f"{type_name}_Response"
        event = f"{type_name}_Event"
        with self._lock:
            for contained in (request, response, _EVENT_INFO):
                self._describe(contained)
            self._put(event, ("info", _name(_EVENT_INFO)), ("request", _few(request)), ("response", _few(response)))
            whole = (("request_message", request), ("response_message", response), ("event_message", event))
            self._put(type_name, *((field, _name(of)) for field, of in whole))
            return self._described.hash_rihs01(type_name)

    def learn_action(self, type_name: str) -> None:
        """Adds the types that ROS generates for an action, so that they can be read and written as bytes.

        Raises:
            ConfigurationError: the type is not known, or is not an action.
        """
        goal, result, feedback = _three(type_name, self._types.parts(type_name))
        with self._lock:
            self._add(f"{type_name}_SendGoal_Request", _UUID, ("goal", _name(goal)))
            accepted = ("accepted", (Nodetype.BASE, ("bool", 0)))
            self._add(f"{type_name}_SendGoal_Response", accepted, ("stamp", _name("builtin_interfaces/msg/Time")))
            self._add(f"{type_name}_GetResult_Request", _UUID)
            status = ("status", (Nodetype.BASE, ("int8", 0)))
            self._add(f"{type_name}_GetResult_Response", status, ("result", _name(result)))
            self._add(f"{type_name}_FeedbackMessage", _UUID, ("feedback", _name(feedback)))

    def _add(self, type_name: str, *fields: Described) -> None:
        if type_name not in self._types._store.fielddefs:
            self._types._store.register({type_name: ([], list(fields))})

    def _describe(self, type_name: str) -> None:
        if type_name in self._described.fielddefs:
            return
        self._types.fields(type_name)
        fields = [(name, _as_hashed(kind)) for name, kind in self._types._store.fielddefs[type_name][1]]
        self._put(type_name, *fields)
        for _, kind in fields:
            if (contained := _contained(kind)) is not None:
                self._describe(contained)

    def _put(self, type_name: str, *fields: Described) -> None:
        self._described.fielddefs[type_name] = ([], list(fields))


def _name(type_name: str) -> Any:
    return (Nodetype.NAME, type_name)


def _few(type_name: str) -> Any:
    """A sequence of at most one."""
    return (Nodetype.SEQUENCE, (_name(type_name), 1))


def _as_hashed(type_: Any) -> Any:
    match type_:
        case (Nodetype.BASE, ("char", limit)):
            return (Nodetype.BASE, ("uint8", limit))
        case ((Nodetype.ARRAY | Nodetype.SEQUENCE) as several, (inner, length)):
            return (several, (_as_hashed(inner), length))
        case _:
            return type_


def _contained(type_: Any) -> str | None:
    match type_:
        case (Nodetype.NAME, type_name):
            return type_name
        case (Nodetype.ARRAY | Nodetype.SEQUENCE, (inner, _)):
            return _contained(inner)
        case _:
            return None


def _three(type_name: str, parts: tuple[str, ...]) -> tuple[str, str, str]:
    match parts:
        case (goal, result, feedback):
            return goal, result, feedback
        case _:
            raise ConfigurationError(where=type_name, problem="is not an action")
