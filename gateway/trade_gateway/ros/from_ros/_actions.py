"""Actions of ROS as TRADE providers: a service with the fields of the goal, progress, a result and a stop."""

from typing import Any, Final

from trade import Resource
from trade_gateway.ros._file import FromAction
from trade_gateway.ros._graph import Graph
from trade_gateway.ros.from_ros._providers import Method, Records, plain, provider
from trade_gateway.ros.from_ros._sent_goals import SentGoals
from trade_gateway.ros.from_ros._services import OfferedProvider

_NO_PARAMETERS: Final[frozenset[str]] = frozenset()


def action_from_ros(entry: FromAction, graph: Graph, records: Records) -> OfferedProvider:
    """``[[from_ros.action]]``. Raises ConfigurationError."""
    goal, result, feedback = graph.types.parts(entry.type)
    parameters, optional = records.parameters(goal)
    returns = records.of(result) if graph.types.fields(result) else None
    name = entry.name or entry.action.rpartition("/")[2]
    moves = [Resource(f"{entry.groups[0]}.{name}")] if entry.effect == "actuate" else []
    goals = SentGoals(graph, entry.action, entry.type, entry.groups[0], moves)

    def carry_out(args: dict[str, Any]) -> Any:
        outcome = goals.carry_out(plain(args), lambda message: records.record(feedback, message))
        return records.record(result, outcome.result)

    def stop(_: dict[str, Any]) -> None:
        goals.stop()

    doc = f"A goal of {entry.action} in ROS ({entry.type})."
    methods = [Method(name, doc, parameters, optional, returns, entry.effect, carry_out, "stop" if moves else None)]
    if moves:
        methods.append(Method("stop", f"Cancel the goals of {entry.action}.", {}, _NO_PARAMETERS, None, "stop", stop))
    return OfferedProvider(f"action {entry.action}", entry.groups, provider("RosAction", methods, moves), lambda: None)
