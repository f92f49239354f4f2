"""The ROS bridge: a TRADE container that is also a ROS node, and maps the services that its file lists."""

import contextlib
import logging
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from typing import Final

from msgspec import Struct

from trade import Container, service
from trade.errors import TradeError
from trade.protocol.schema_types import publish
from trade_gateway.ros._file import RosFile
from trade_gateway.ros._graph import Graph
from trade_gateway.ros._mapping_sync import Following, Mapping
from trade_gateway.ros._nodes import Nodes
from trade_gateway.ros.from_ros._actions import action_from_ros
from trade_gateway.ros.from_ros._joints import joints_from_ros
from trade_gateway.ros.from_ros._providers import Records
from trade_gateway.ros.from_ros._services import (
    OfferedProvider,
    parameters_from_ros,
    publisher_from_ros,
    service_from_ros,
    topic_from_ros,
)
from trade_gateway.ros.to_ros._actions import ActionsToRos, GrippersToRos
from trade_gateway.ros.to_ros._commands import CommandsToRos
from trade_gateway.ros.to_ros._robot import Description, TransformsToRos
from trade_gateway.ros.to_ros._services import LocksToRos, ServicesToRos
from trade_gateway.ros.to_ros._streams import JointStatesToRos, StreamsToRos, Topics
from trade_gateway.ros.to_ros._trajectories import TrajectoriesToRos

_logger = logging.getLogger("trade")

_LONGEST: Final = 400
"""Most characters of a health text."""
HEALTHY: Final = "healthy"
GROUP: Final = "ros"
"""Group of the bridge's own service."""


class BridgeMappings(Struct, frozen=True):
    """What a bridge maps now."""

    to_ros: dict[str, str]
    """By kind and name in ROS (``service /rosie/head/stop``), the TRADE service."""
    from_ros: dict[str, list[str]]
    """By its name in ROS, the groups in which it is offered."""
    nodes: list[str]
    """Nodes of ROS that have a session here now."""
    problems: list[str]
    """Entries that are not mapped, and why."""


publish("trade_gateway.ros", BridgeMappings)


class Bridge:
    """Maps services in both directions until it is closed.

    Args:
        container: the bridge's container and identity in TRADE.
        graph: the ROS system.
        file: the entries to map.
        say: receives one line for each entry that is mapped, ends or fails.

    Raises:
        ConfigurationError: a type is not known, or does not fit.
        AccessDenied: the policy does not let this container register group ``ros``, or one that the file names.
    """

    def __init__(self, container: Container, graph: Graph, file: RosFile, say: Callable[[str], object]) -> None:
        self._container = container
        self._say = say
        self._leaving = ExitStack()
        self._offered: list[OfferedProvider] = []
        with contextlib.ExitStack() as failing:
            failing.callback(self.close)
            container.register(self, GROUP)
            self._leaving.callback(container.deregister, self)
            self._nodes = Nodes(container, graph, file.ros.grace_s, self._heard)
            self._leaving.callback(self._nodes.close)
            self._offer(graph, file)
            for entry in file.to_ros.robot:
                self._leaving.callback(Description(entry, graph).close)
                self._say(f"topic {entry.topic} is {entry.urdf}")
            self._following = Following(container, self._mappings(graph, file), say)
            self._leaving.callback(self._following.close)
            self._leaving.callback(self._nodes.close)  # first of all: motion of ROS nodes stops, and no call begins
            failing.pop_all()

    def _mappings(self, graph: Graph, file: RosFile) -> list[Mapping]:
        out, nodes, topics = file.to_ros, self._nodes, Topics(graph)
        return [
            *(ServicesToRos(entry, graph, nodes) for entry in out.service),
            *(LocksToRos(entry, graph, nodes, self._container) for entry in out.lock),
            *(CommandsToRos(entry, graph, nodes, self._container, self._say) for entry in out.command),
            *(StreamsToRos(entry, topics, graph, self._container) for entry in out.stream),
            *(JointStatesToRos(entry, topics, self._container) for entry in out.joint_states),
            *(TransformsToRos(entry, topics, self._container) for entry in out.robot),
            *(TrajectoriesToRos(entry, graph, nodes, self._container) for entry in out.trajectory),
            *(ActionsToRos(entry, graph, nodes) for entry in out.action),
            *(GrippersToRos(entry, graph, nodes) for entry in out.gripper),
        ]

    def _offer(self, graph: Graph, file: RosFile) -> None:
        into, records = file.from_ros, Records(graph.types)
        makes: list[Callable[[], OfferedProvider]] = [
            *(partial(service_from_ros, entry, graph, records) for entry in into.service),
            *(partial(topic_from_ros, entry, graph, records) for entry in into.topic),
            *(partial(publisher_from_ros, entry, graph, records) for entry in into.publish),
            *(partial(action_from_ros, entry, graph, records) for entry in into.action),
            *(partial(joints_from_ros, entry, graph) for entry in into.joints),
            *(partial(parameters_from_ros, entry, graph) for entry in into.parameters),
        ]
        for make in makes:
            offered = make().offer(self._container)
            self._offered.append(offered)
            self._leaving.callback(offered.withdraw, self._container)
            self._say(f"{offered.where} is in {', '.join(offered.groups)}")

    def settled(self, timeout_s: float) -> bool:
        """Waits until the services present now are mapped. Returns whether they are."""
        return self._following.settled(timeout_s)

    @service(effect="read")
    def bridged(self) -> BridgeMappings:
        """The mapped entries, the nodes that use them, and the entries that are not mapped."""
        offered = {one.where: one.groups for one in self._offered}
        return BridgeMappings(self._following.opened(), offered, self._nodes.names(), self._following.problems())

    def _heard(self, problem: str) -> None:
        """Handles the loss and the return of ROS."""
        if problem:
            self._health(f"ROS is lost: {problem}"[:_LONGEST])
            self._say(f"ROS is lost: {problem}; motion of its nodes stops, and their locks are released")
        else:
            self._health(HEALTHY)
            self._say("ROS is back")

    def _health(self, text: str) -> None:
        for one in (self, *(offered.provider for offered in self._offered)):
            try:
                self._container.set_health(one, text)
            except TradeError as error:  # it ends, or is not registered yet
                _logger.info("the health of %s could not be set: %s", type(one).__name__, error)

    def close(self) -> None:
        """Stops motion of ROS nodes and ends all mappings. Idempotent."""
        self._leaving.close()
