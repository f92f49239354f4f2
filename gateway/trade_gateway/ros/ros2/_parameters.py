"""Parameters of ROS 2 nodes, through the services that each node has for them; the bridge's own node has none.

Facts, from ``rcl_interfaces``: values are numbered by type, ``ParameterType.msg``; depth 0 requests lists of any
depth. A parameter has the type it was declared with: a whole number for a ``double`` is refused.
"""

from collections.abc import Callable, Mapping
from typing import Any, Final, cast

from trade.errors import ConfigurationError
from trade_gateway.ros._graph import Answer, RosRefused
from trade_gateway.ros.ros2._node import Node
from trade_gateway.ros.ros2._services import Server, answering
from trade_gateway.ros_messages._types import Message

Call = Callable[[str, str, Mapping[str, Any], float], Message]
"""Calls a service: its name, its type, the request, a timeout in seconds."""

_FIELDS: Final = {
    1: "bool_value",
    2: "integer_value",
    3: "double_value",
    4: "string_value",
    5: "byte_array_value",
    6: "bool_array_value",
    7: "integer_array_value",
    8: "double_array_value",
    9: "string_array_value",
}
_OF_ONE: Final = {bool: 1, int: 2, float: 3, str: 4, bytes: 5}
_OF_MANY: Final = {bool: 6, int: 7, float: 8, str: 9}
_NUMBERS: Final = (2, 7)
"""Whole numbers, scalar and array; the types of fractional numbers follow them."""
_PACKAGE: Final = "rcl_interfaces/srv"


def all_of(call: Call, node: str, timeout_s: float) -> dict[str, Any]:
    """See `Graph.parameters`. The timeout applies to each of two services."""
    names = call(f"{node}/list_parameters", f"{_PACKAGE}/ListParameters", {}, timeout_s)["result"]["names"]
    values = call(f"{node}/get_parameters", f"{_PACKAGE}/GetParameters", {"names": names}, timeout_s)["values"]
    return {name: _value(value) for name, value in zip(names, values, strict=False)}


def put(call: Call, node: str, name: str, value: Any, timeout_s: float) -> None:
    """See `Graph.set_parameter`. The timeout applies to each of two services."""
    types = call(f"{node}/get_parameter_types", f"{_PACKAGE}/GetParameterTypes", {"names": [name]}, timeout_s)["types"]
    parameter = {"name": name, "value": _typed(name, value, types[0] if types else 0)}
    asked = {"parameters": [parameter]}
    (result,) = call(f"{node}/set_parameters", f"{_PACKAGE}/SetParameters", asked, timeout_s)["results"] or [None]
    if result is None or not result["successful"]:
        reason = "the node did not answer for it" if result is None else result["reason"] or "the node gave no reason"
        raise RosRefused(what=f"parameter {name} of {node}", problem=f"was not set to {value!r}: {reason}")


class NoParameters:
    """The parameter services of the bridge's node, so that clients that ask for its parameters need not wait."""

    def __init__(self, node: Node) -> None:
        answers: dict[str, Callable[[Message], Message]] = {
            "DescribeParameters": lambda _: {},
            "GetParameters": lambda asked: {"values": [{} for _ in asked["names"]]},
            "GetParameterTypes": lambda asked: {"types": bytes(len(asked["names"]))},
            "ListParameters": lambda _: {},
            "SetParameters": lambda asked: {"results": [_NONE_TO_SET for _ in asked["parameters"]]},
            "SetParametersAtomically": lambda _: {"result": _NONE_TO_SET},
        }
        self._servers = [
            Server(node, f"{node.name}/{_snake(name)}", f"{_PACKAGE}/{name}", answering(_by(answer)))
            for name, answer in answers.items()
        ]

    def close(self) -> None:
        """Ends the services. Idempotent."""
        for server in self._servers:
            server.close()


_NONE_TO_SET: Final = {"successful": False, "reason": "this node has no parameters"}


def _by(answer: Callable[[Message], Message]) -> Answer:
    return lambda asked, _who, _came_at: answer(asked)


def _snake(name: str) -> str:
    return "".join(f"_{letter.lower()}" if letter.isupper() else letter for letter in name)[1:]


def _value(value: Message) -> Any:
    field = _FIELDS.get(value["type"])
    return None if field is None else value[field]


def _typed(name: str, value: object, declared: int) -> Message:
    several = isinstance(value, list)
    given: list[Any] = cast("list[Any]", value) if several else [value]
    number = _type_of(given, _OF_MANY if several else _OF_ONE, declared)
    if number is None:
        problem = (
            f"{value!r} can be no value: one bool, number, text or bytes, or a list of one kind of the first three"
        )
        raise ConfigurationError(where=f"parameter {name}", problem=problem)
    if number in _NUMBERS and declared == number + 1:
        number = declared
        given = [float(each) for each in given]
    return {"type": number, _FIELDS[number]: given if several else given[0]}


def _type_of(given: list[Any], known: Mapping[type, int], declared: int) -> int | None:
    if not given:
        return declared if declared in known.values() else None
    kinds: set[type] = {type(each) for each in given}
    if kinds == {int, float}:
        return known[float]
    return known.get(kinds.pop()) if len(kinds) == 1 else None
