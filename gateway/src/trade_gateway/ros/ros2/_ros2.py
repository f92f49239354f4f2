"""A system of ROS 2 that uses rmw_zenoh, seen from its router; nothing of ROS is installed here."""

import threading
import weakref
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from trade.errors import ConfigurationError
from trade_gateway.ros._graph import Answer, Closes, Goal, Graph, Heard, NodeTold, Outcome, Publisher, Pursuit
from trade_gateway.ros._types import Message, Types
from trade_gateway.ros.ros2 import _parameters
from trade_gateway.ros.ros2._goals import Action
from trade_gateway.ros.ros2._link import Link
from trade_gateway.ros.ros2._node import Node
from trade_gateway.ros.ros2._pursuit import Pursuing
from trade_gateway.ros.ros2._services import Client, Server, answering
from trade_gateway.ros.ros2._topics import Topic, TopicHeard

__all__ = ["Ros2"]

_Opened = TypeVar("_Opened", bound=Closes)


class Ros2(Graph):
    """A `Graph` over the key space of rmw_zenoh.

    The name of a sender comes from the gid in its message, which is the hash of its liveliness token; it is empty for
    who has no token, or does not make its gid that way.
    """

    def __init__(
        self,
        router: str = "tcp/localhost:7447",
        domain_id: int = 0,
        node: str = "/trade",
        folders: Iterable[Path] = (),
    ) -> None:
        """Does not wait for the router; see `healthy`.

        Args:
            router: where ``rmw_zenohd`` listens, as zenoh writes endpoints.
            domain_id: ``ROS_DOMAIN_ID`` of that system.
            node: our name in it, absolute; nobody else may have it.
            folders: of definitions of types, see `Types`.

        Raises:
            ConfigurationError: one of these is wrong.
        """
        if domain_id < 0:
            raise ConfigurationError(where="ROS domain", problem=f"{domain_id} must be 0 or more, as ROS_DOMAIN_ID is")
        self._types = Types(2, folders)
        self._link = Link(router)
        self._lock = threading.Lock()
        self._opened: weakref.WeakSet[Closes] = weakref.WeakSet()
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
        """See `Graph`. Raises ConfigurationError: its name or type is none."""
        return self._keep(Topic(self._node, topic, type_name, latched=latched))

    def subscribe(self, topic: str, type_name: str, heard: Heard, *, latched: bool = False) -> Closes:
        """See `Graph`; latched: what was published before is told, too, if its publisher keeps it.

        While a call of `heard` lasts, ten messages wait at most, and none longer than a second.

        Raises:
            ConfigurationError: its name or type is none.
        """
        return self._keep(TopicHeard(self._node, topic, type_name, heard, latched=latched))

    def serve(self, name: str, type_name: str, answer: Answer, *, stops: bool = False) -> Closes:
        """See `Graph`. Raises ConfigurationError: its name or type is none."""
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
        """See `Graph`. Raises also ConfigurationError: the name or type is none, or the request does not fit."""
        with self._lock:
            client = self._clients.get((name, type_name))
            if client is None:
                client = self._clients[name, type_name] = Client(self._node, name, type_name)
        return client.call(request, timeout_s)

    def act(self, name: str, type_name: str, do: Callable[[Goal], Outcome]) -> Closes:
        """See `Graph`. Raises ConfigurationError: its name or type is none."""
        return self._keep(Action(self._node, name, type_name, do))

    def pursue(
        self, name: str, type_name: str, goal: Mapping[str, Any], feedback: Callable[[Message], object] | None = None
    ) -> Pursuit:
        """See `Graph`; waits up to 5 s for the goal to be accepted. What has not ended at our end is canceled.

        A goal whose acceptance is not heard of may begin any time: it is told to end for some seconds, and has not
        ended before; `Pursuit.wait` raises RosUnreachable then, and says whether it was canceled.

        Raises:
            RosUnreachable: nobody serves it: it was not sent.
            ConfigurationError: the name or type is none, or the goal does not fit.
        """
        pursuing = self._keep(Pursuing(self._node, name, type_name, feedback))
        pursuing.begin(goal)
        return pursuing

    def parameters(self, node: str, timeout_s: float) -> dict[str, Any]:
        """See `Graph`."""
        return _parameters.all_of(self.call, node, timeout_s)

    def set_parameter(self, node: str, name: str, value: Any, timeout_s: float) -> None:
        """See `Graph`. Raises also ConfigurationError: there are no parameters of that kind."""
        _parameters.put(self.call, node, name, value, timeout_s)

    def watch_nodes(self, told: NodeTold) -> Closes:
        """See `Graph`. Not told of is our own node; of nodes that freeze or are cut off, see `_presence`."""
        return self._keep(self._node.presence.watch(told))

    @property
    def healthy(self) -> str:
        return self._link.problem

    def close(self) -> None:
        """See `Graph`; goals of ours that go on are canceled."""
        with self._lock:
            opened, clients = list(self._opened), list(self._clients.values())
            self._clients.clear()
        opened.sort(key=lambda each: not isinstance(each, Pursuing))  # what moves goes first
        for each in (*opened, *clients, self._node, self._link):
            each.close()

    def _keep(self, opened: _Opened) -> _Opened:
        with self._lock:
            self._opened.add(opened)
        return opened
