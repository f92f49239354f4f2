"""The bridge: one container of ours that is one node of theirs, with what a file says mapped between the two."""

import contextlib
import logging
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from typing import Final

from msgspec import Struct

from trade import Container, service
from trade.errors import TradeError
from trade_gateway.ros._file import RosFile
from trade_gateway.ros._from_ros import (
    Offered,
    parameters_from_ros,
    publisher_from_ros,
    service_from_ros,
    topic_from_ros,
)
from trade_gateway.ros._from_ros_joints import joints_from_ros
from trade_gateway.ros._graph import Graph
from trade_gateway.ros._mapping_sync import Following, Mapping
from trade_gateway.ros._nodes import Nodes
from trade_gateway.ros._providers import Records
from trade_gateway.ros._to_ros_commands import CommandsToRos
from trade_gateway.ros._to_ros_services import LocksToRos, ServicesToRos
from trade_gateway.ros._to_ros_streams import JointStatesToRos, StreamsToRos, Topics
from trade_gateway.ros._to_ros_trajectories import TrajectoriesToRos

__all__ = ["GROUP", "Bridge", "Bridged"]

_logger = logging.getLogger("trade")

_LONGEST: Final = 400
"""Characters of a health."""
HEALTHY: Final = "healthy"
GROUP: Final = "ros"
"""Of what the bridge tells of itself."""


class Bridged(Struct, frozen=True):
    """What a bridge has up."""

    to_ros: dict[str, str]
    """By kind and name in ROS (``service /rosie/head/stop``), the service of ours."""
    from_ros: dict[str, list[str]]
    """By what it is in ROS, the groups it is offered in."""
    nodes: list[str]
    """Those of ROS that have a session here now."""
    problems: list[str]
    """What is not up, and why."""


class Bridge:
    """Maps until it is closed.

    Args:
        container: ours; it is the bridge's identity.
        graph: theirs.
        file: what is mapped.
        say: told in a line what comes up, goes, or cannot be.

    Raises:
        ConfigurationError: a type is not known, or does not fit.
        AccessDenied: the policy does not let this container register group ``ros``, or one that the file names.
    """

    def __init__(self, container: Container, graph: Graph, file: RosFile, say: Callable[[str], object]) -> None:
        self._container = container
        self._say = say
        self._leaving = ExitStack()
        self._offered: list[Offered] = []
        with contextlib.ExitStack() as failing:
            failing.callback(self.close)
            container.register(self, GROUP)
            self._leaving.callback(container.deregister, self)
            self._nodes = Nodes(container, graph, file.ros.grace_s, self._heard)
            self._leaving.callback(self._nodes.close)
            self._offer(graph, file)
            self._following = Following(container, self._mappings(graph, file), say)
            self._leaving.callback(self._following.close)
            self._leaving.callback(self._nodes.close)  # before all else: what they move stops, and nothing begins
            failing.pop_all()

    def _mappings(self, graph: Graph, file: RosFile) -> list[Mapping]:
        out, nodes, topics = file.to_ros, self._nodes, Topics(graph)
        return [
            *(ServicesToRos(entry, graph, nodes) for entry in out.service),
            *(LocksToRos(entry, graph, nodes, self._container) for entry in out.lock),
            *(CommandsToRos(entry, graph, nodes, self._container, self._say) for entry in out.command),
            *(StreamsToRos(entry, topics, graph, self._container) for entry in out.stream),
            *(JointStatesToRos(entry, topics, self._container) for entry in out.joint_states),
            *(TrajectoriesToRos(entry, graph, nodes, self._container) for entry in out.trajectory),
        ]

    def _offer(self, graph: Graph, file: RosFile) -> None:
        into, records = file.from_ros, Records(graph.types)
        makes: list[Callable[[], Offered]] = [
            *(partial(service_from_ros, entry, graph, records) for entry in into.service),
            *(partial(topic_from_ros, entry, graph, records) for entry in into.topic),
            *(partial(publisher_from_ros, entry, graph, records) for entry in into.publish),
            *(partial(joints_from_ros, entry, graph) for entry in into.joints),
            *(partial(parameters_from_ros, entry, graph) for entry in into.parameters),
        ]
        for make in makes:
            offered = make().offer(self._container)
            self._offered.append(offered)
            self._leaving.callback(offered.withdraw, self._container)
            self._say(f"{offered.where} is in {', '.join(offered.groups)}")

    def settled(self, timeout_s: float) -> bool:
        """Wait until what is there already was mapped. Returns whether it was."""
        return self._following.settled(timeout_s)

    @service(effect="read")
    def bridged(self) -> Bridged:
        """What is up, for whom, and what is not."""
        offered = {one.where: one.groups for one in self._offered}
        return Bridged(self._following.opened(), offered, self._nodes.names(), self._following.problems())

    def _heard(self, problem: str) -> None:
        """ROS is lost, or back."""
        if problem:
            self._health(f"ROS is lost: {problem}"[:_LONGEST])
            self._say(f"ROS is lost: {problem}; what its nodes moved stops, and their locks fall")
        else:
            self._health(HEALTHY)
            self._say("ROS is back")

    def _health(self, text: str) -> None:
        for one in (self, *(offered.provider for offered in self._offered)):
            try:
                self._container.set_health(one, text)
            except TradeError as error:  # it leaves, or is not there yet
                _logger.info("the health of %s could not be told: %s", type(one).__name__, error)

    def close(self) -> None:
        """What nodes of ROS move stops, and nothing is mapped any more. Idempotent."""
        self._leaving.close()
