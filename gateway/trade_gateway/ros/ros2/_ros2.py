"""A ROS 2 system that uses rmw_zenoh, accessed through its router; it needs no ROS installation on this host."""

import threading
import weakref
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from trade.errors import ConfigurationError
from trade_gateway.ros._graph import (
    ActionGoal,
    Answer,
    Closable,
    Goal,
    Graph,
    Heard,
    NodeListener,
    Outcome,
    Publisher,
    Refuse,
)
from trade_gateway.ros.ros2 import _parameters
from trade_gateway.ros.ros2._goals import Action
from trade_gateway.ros.ros2._link import Link
from trade_gateway.ros.ros2._node import Node
from trade_gateway.ros.ros2._pursuit import Ros2ActionGoal
from trade_gateway.ros.ros2._services import Client, Server, answering
from trade_gateway.ros.ros2._topics import Topic, TopicSubscription
from trade_gateway.ros_messages._types import Message, Types, installed_definitions

_Opened = TypeVar("_Opened", bound=Closable)


class Ros2(Graph):
    """A `Graph` over the key space of rmw_zenoh.

    A sender's name comes from the gid in its message, which is the hash of its liveliness token. It is empty for a
    sender that has no token, or makes its gid in another way.
    """

    def __init__(
        self,
        router: str = "tcp/localhost:7447",
        domain_id: int = 0,
        node: str = "/trade",
        folders: Iterable[Path] = (),
    ) -> None:
        """Returns without waiting for the router; see `healthy`.

        Args:
            router: where ``rmw_zenohd`` listens, as an endpoint of zenoh.
            domain_id: ``ROS_DOMAIN_ID`` of that system.
            node: the bridge's name in it, absolute and unique.
            folders: folders of type definitions, see `Types`.

        Raises:
            ConfigurationError: one of these is invalid.
        """
        if domain_id < 0:
            raise ConfigurationError(where="ROS domain", problem=f"{domain_id} must be 0 or more, as ROS_DOMAIN_ID is")
        self._types = Types(2, folders, installed_definitions(2))
        self._link = Link(router)
        self._lock = threading.Lock()
        self._opened: weakref.WeakSet[Closable] = weakref.WeakSet()
        self._clients: dict[tuple[str, str], Client] = {}
        try:
            self._node = Node(self._link, domain_id, node, self._types)
            self._parameters = self._keep(_parameters.NoParameters(self._node))
        except BaseException:
            self._link.close()
            raise

    @property
    def types(self) -> Types:
        return self._types

    def advertise(self, topic: str, type_name: str, *, latched: bool = False) -> Publisher:
        """See `Graph`. Raises ConfigurationError: its name or type is invalid."""
        return self._keep(Topic(self._node, topic, type_name, latched=latched))

    def subscribe(self, topic: str, type_name: str, callback: Heard, *, latched: bool = False) -> Closable:
        """See `Graph`; latched: also delivers earlier messages that the publisher keeps.

        While a call of `heard` lasts, at most ten messages wait, each for at most a second.

        Raises:
            ConfigurationError: its name or type is invalid.
        """
        return self._keep(TopicSubscription(self._node, topic, type_name, callback, latched=latched))

    def serve(self, name: str, type_name: str, answer: Answer, *, stops: bool = False) -> Closable:
        """See `Graph`. Raises ConfigurationError: its name or type is invalid."""
        return self._keep(Server(self._node, name, type_name, answering(answer), stops=stops))

    def call(
        self,
        name: str,
        type_name: str,
        request: Mapping[str, Any],
        timeout_s: float,
        *,
        stops: bool = False,  # noqa: ARG002 - no call waits for another here
    ) -> Message:
        """See `Graph`. Raises also ConfigurationError: the name or type is invalid, or the request does not fit."""
        with self._lock:
            client = self._clients.get((name, type_name))
            if client is None:
                client = self._clients[name, type_name] = Client(self._node, name, type_name)
        return client.call(request, timeout_s)

    def act(self, name: str, type_name: str, do: Callable[[Goal], Outcome], refuse: Refuse | None = None) -> Closable:
        """See `Graph`. Raises ConfigurationError: its name or type is invalid."""
        return self._keep(Action(self._node, name, type_name, do, refuse))

    def pursue(
        self, name: str, type_name: str, goal: Mapping[str, Any], feedback: Callable[[Message], object] | None = None
    ) -> ActionGoal:
        """See `Graph`; waits up to 5 s for the goal to be accepted. Goals that still run are canceled on closing.

        A goal without a known answer may begin at any time. It is canceled for some seconds and counts as running
        meanwhile; `ActionGoal.wait` then raises RosUnreachable, which says whether the goal was canceled.

        Raises:
            RosUnreachable: no node serves the action, so the goal was not sent.
            ConfigurationError: the name or type is invalid, or the goal does not fit.
        """
        pursuing = self._keep(Ros2ActionGoal(self._node, name, type_name, feedback))
        pursuing.begin(goal)
        return pursuing

    def parameters(self, node: str, timeout_s: float) -> dict[str, Any]:
        """See `Graph`."""
        return _parameters.all_of(self.call, node, timeout_s)

    def set_parameter(self, node: str, name: str, value: Any, timeout_s: float) -> None:
        """See `Graph`. Raises also ConfigurationError: ROS has no parameters of that kind."""
        _parameters.put(self.call, node, name, value, timeout_s)

    def watch_nodes(self, listener: NodeListener) -> Closable:
        """See `Graph`. The bridge's own node is not reported; for frozen or disconnected nodes see `_presence`."""
        return self._keep(self._node.presence.watch(listener))

    @property
    def healthy(self) -> str:
        return self._link.problem

    def close(self) -> None:
        """See `Graph`; cancels goals of the bridge that still run."""
        with self._lock:
            opened, clients = list(self._opened), list(self._clients.values())
            self._clients.clear()
        opened.sort(key=lambda each: not isinstance(each, Ros2ActionGoal))  # what moves goes first
        for each in (*opened, *clients, self._node, self._link):
            each.close()

    def _keep(self, opened: _Opened) -> _Opened:
        with self._lock:
            self._opened.add(opened)
        return opened
