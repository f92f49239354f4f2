"""Parameters. The node asked is one of TRADE, which answers as the definitions of ``rcl_interfaces`` say; the hashes of
the services' types are judged elsewhere, by those of ROS 2 itself.
"""

from collections.abc import Callable
from typing import Any

import pytest

from tests.support.ros2_processes import Router, until_offered
from trade.errors import ConfigurationError
from trade_gateway.ros._graph import RosRefused, RosUnreachable
from trade_gateway.ros.ros2 import Ros2

LONG_S = 60.0
SRV = "rcl_interfaces/srv"
SERVICES = {
    "list_parameters": "ListParameters",
    "get_parameters": "GetParameters",
    "get_parameter_types": "GetParameterTypes",
    "set_parameters": "SetParameters",
}
VALUES: dict[str, dict[str, Any]] = {
    "enabled": {"type": 1, "bool_value": True},
    "count": {"type": 2, "integer_value": -7},
    "gain": {"type": 3, "double_value": 0.5},
    "frame.id": {"type": 4, "string_value": "base"},
    "blob": {"type": 5, "byte_array_value": b"\1\2"},
    "flags": {"type": 6, "bool_array_value": [True, False]},
    "ids": {"type": 7, "integer_array_value": [1, 2]},
    "limits": {"type": 8, "double_array_value": [0.25, 1.0]},
    "names": {"type": 9, "string_array_value": ["a", "b"]},
    "unset": {"type": 0},
}


class Offering:
    """The services of a node with parameters."""

    def __init__(self, graph: Ros2, node: str) -> None:
        self.set: list[dict[str, Any]] = []
        self.refusal = ""
        answers: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
            "list_parameters": lambda asked: {"result": {"names": list(VALUES)}},
            "get_parameters": lambda asked: {"values": [VALUES[name] for name in asked["names"]]},
            "get_parameter_types": lambda asked: {"types": bytes(VALUES[name]["type"] for name in asked["names"])},
            "set_parameters": self._put,
        }
        for name, kind in SERVICES.items():
            answer = answers[name]
            graph.serve(f"{node}/{name}", f"{SRV}/{kind}", lambda asked, _who, _at, answer=answer: answer(asked))

    def _put(self, asked: dict[str, Any]) -> dict[str, Any]:
        self.set += asked["parameters"]
        return {"results": [{"successful": not self.refusal, "reason": self.refusal}]}


@pytest.fixture
def offering(graph: Ros2, router: Router, open_graph: Callable[..., Ros2]) -> Offering:
    offered = Offering(open_graph(router, node="/elsewhere"), "/camera")
    for name, kind in SERVICES.items():
        until_offered(graph, f"/camera/{name}", f"{SRV}/{kind}")
    return offered


def test_parameters_of_all_types_are_read(graph: Ros2, offering: Offering) -> None:
    assert graph.parameters("/camera", LONG_S) == {
        "enabled": True,
        "count": -7,
        "gain": 0.5,
        "frame.id": "base",
        "blob": b"\1\2",
        "flags": [True, False],
        "ids": [1, 2],
        "limits": [0.25, 1.0],
        "names": ["a", "b"],
        "unset": None,
    }


@pytest.mark.parametrize(
    ("name", "value", "number", "field"),
    [
        ("enabled", False, 1, "bool_value"),
        ("count", 3, 2, "integer_value"),
        ("gain", 0.1, 3, "double_value"),
        ("frame.id", "tool", 4, "string_value"),
        ("blob", b"\7", 5, "byte_array_value"),
        ("flags", [False], 6, "bool_array_value"),
        ("ids", [3], 7, "integer_array_value"),
        ("limits", [0.5], 8, "double_array_value"),
        ("names", ["c"], 9, "string_array_value"),
        ("unset", "new", 4, "string_value"),
    ],
)
def test_a_parameter_is_set_as_what_it_is(
    graph: Ros2, offering: Offering, name: str, value: Any, number: int, field: str
) -> None:
    graph.set_parameter("/camera", name, value, LONG_S)
    (put,) = offering.set
    assert (put["name"], put["value"]["type"], put["value"][field]) == (name, number, value)


@pytest.mark.parametrize(("name", "value", "put"), [("gain", 2, 2.0), ("limits", [1, 2.5], [1.0, 2.5])])
def test_a_whole_number_fits_a_parameter_of_numbers(
    graph: Ros2, offering: Offering, name: str, value: Any, put: Any
) -> None:
    graph.set_parameter("/camera", name, value, LONG_S)
    reported = offering.set[0]["value"]
    assert put in (reported["double_value"], reported["double_array_value"])


def test_an_empty_list_is_of_the_type_the_parameter_has(graph: Ros2, offering: Offering) -> None:
    graph.set_parameter("/camera", "names", [], LONG_S)
    assert offering.set[0]["value"]["type"] == 9


@pytest.mark.parametrize("value", [None, {}, [1, "a"], [None], [], [[1]]])
def test_a_value_that_is_no_valid_parameter_is_not_sent(graph: Ros2, offering: Offering, value: Any) -> None:
    with pytest.raises(ConfigurationError, match="can be no value"):
        graph.set_parameter("/camera", "unset", value, LONG_S)
    assert not offering.set


def test_a_refusal_says_why(graph: Ros2, offering: Offering) -> None:
    offering.refusal = "read only"
    with pytest.raises(RosRefused, match=r"parameter gain of /camera: was not set to 9\.0: read only"):
        graph.set_parameter("/camera", "gain", 9.0, LONG_S)


@pytest.mark.slow
def test_a_node_without_the_services_is_unreachable(graph: Ros2) -> None:
    with pytest.raises(RosUnreachable, match="/missing/list_parameters"):
        graph.parameters("/missing", LONG_S)


@pytest.mark.slow
def test_our_own_node_has_none_and_says_so(graph: Ros2, router: Router, open_graph: Callable[..., Ros2]) -> None:
    asks = open_graph(router, node="/asks")
    others = {"describe_parameters": "DescribeParameters", "set_parameters_atomically": "SetParametersAtomically"}
    for name, kind in (SERVICES | others).items():
        until_offered(asks, f"/trade/{name}", f"{SRV}/{kind}")
    assert asks.parameters("/trade", LONG_S) == {}
    with pytest.raises(RosRefused, match="this node has no parameters"):
        asks.set_parameter("/trade", "x", 1, LONG_S)
    assert asks.call("/trade/describe_parameters", f"{SRV}/DescribeParameters", {}, LONG_S) == {"descriptors": []}
    result = asks.call("/trade/set_parameters_atomically", f"{SRV}/SetParametersAtomically", {}, LONG_S)
    assert result["result"]["successful"] is False
