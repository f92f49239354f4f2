"""The `Graph` of ROS 1: this process encodes the types; a node in a child process does everything else."""

import os
import re
import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, cast

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
    RosRefused,
)
from trade_gateway.ros._mailbox import Mailbox
from trade_gateway.ros.ros1._action_client import ActionClient
from trade_gateway.ros.ros1._action_server import ActionServer
from trade_gateway.ros.ros1._link import Link, Opened
from trade_gateway.ros.ros1._node._frames import Head
from trade_gateway.ros.ros1._service import Served
from trade_gateway.ros.ros1._topics import HeardAt, PublishedTopic
from trade_gateway.ros.ros1._wire import message_head, service_head
from trade_gateway.ros_messages._types import Message, Types, installed_definitions


class Nodes:
    """The visible nodes. Each watcher is called on its own thread, in order, with every change."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._there: set[str] = set()
        self._watchers: dict[int, Mailbox[tuple[str, bool]]] = {}
        self._watched = 0

    def report(self, name: str, there: bool) -> None:
        """Reports that a node came or went."""
        with self._lock:
            if there == (name in self._there):
                return
            (self._there.add if there else self._there.discard)(name)
            for watcher in self._watchers.values():
                watcher.put((name, there))

    def none(self) -> None:
        """Reports that no node is visible any more."""
        for name in sorted(self._there):
            self.report(name, False)

    def watch(self, listener: NodeListener) -> Callable[[], None]:
        """Reports the present nodes and every change; returns what ends it."""
        watcher = Mailbox[tuple[str, bool]]("trade-ros1-nodes", lambda news: listener(*news), end_s=0.0)
        with self._lock:
            self._watched += 1
            number = self._watched
            self._watchers[number] = watcher
            for name in sorted(self._there):
                watcher.put((name, True))

        def end() -> None:
            with self._lock:
                self._watchers.pop(number, None)
            watcher.close()

        return end


_NAME: Final = re.compile(r"(/[A-Za-z]\w*)+", re.ASCII)
_MASTER: Final = "http://localhost:11311"
_NEWEST: Final = 10
"""Number of messages of a topic that wait in each queue."""


@dataclass(frozen=True, eq=False)
class _Closing:
    """Something open that these steps close; each step may run twice."""

    steps: tuple[Callable[[], object], ...]

    def close(self) -> None:
        for step in self.steps:
            step()


class Ros1(Graph):
    """A ROS 1 system, accessed as a node of it. See `Graph`."""

    def __init__(
        self,
        master: str = "",
        node: str = "/trade",
        python: str = "/usr/bin/python3",
        folders: Iterable[Path] = (),
        ip: str = "",
    ) -> None:
        """Returns at once; `healthy` shows when the node is registered with the master.

        Args:
            master: the master's URI; else ``ROS_MASTER_URI``, or ``http://localhost:11311``.
            node: the bridge's name in ROS.
            python: an interpreter that has rospy.
            folders: folders of type definitions, see `Types`.
            ip: address under which others reach us (``ROS_IP``). Without it, the environment decides (``ROS_IP``,
                ``ROS_HOSTNAME``); else loopback if the master is on loopback, and otherwise the choice of ROS.

        Raises:
            ConfigurationError: a name is not a name of ROS, or a definition cannot be read.
        """
        self._types = Types(1, folders, installed_definitions(1))
        self._nodes = Nodes()
        self._lock = threading.RLock()
        self._clients: dict[str, ActionClient] = {}
        self._open: set[Closable] = set()
        self.node: Final = _name(node, "node")
        master = master or os.environ.get("ROS_MASTER_URI", "") or _MASTER
        self._link = Link(master=master, node=node, python=python, ip=ip, changed=self._node, alone=self._nodes.none)

    @property
    def types(self) -> Types:
        return self._types

    @property
    def healthy(self) -> str:
        return self._link.healthy

    # --- topics

    def advertise(self, topic: str, type_name: str, *, latched: bool = False) -> Publisher:
        return self.publish(topic, type_name, latched=latched, most=_NEWEST)

    def publish(self, topic: str, type_name: str, *, latched: bool, most: int) -> PublishedTopic:
        """As `advertise`; at most `most` messages wait, the newest ones."""
        head = self._topic("publish", topic, type_name)
        return PublishedTopic(self._types, type_name, self._link.open({**head, "latched": latched}, _nothing, most))

    def subscribe(self, topic: str, type_name: str, callback: Heard, *, latched: bool = False) -> Closable:
        def came(message: Message, sender: str, _: float) -> None:
            callback(message, sender)

        return self._closing(self.hear(topic, type_name, came, most=_NEWEST, latched=latched)[1])

    def hear(
        self, topic: str, type_name: str, callback: HeardAt, *, most: int, latched: bool = True
    ) -> tuple[Opened, tuple[Callable[[], object], ...]]:
        """As `subscribe`; at most `most` messages wait, the newest ones. The node shares our monotonic clock."""
        head = {**self._topic("subscribe", topic, type_name), "latched": latched}

        def tell(message: tuple[Head, bytes]) -> None:
            head, body = message
            callback(self._types.from_bytes(type_name, body), head["who"], head["at"])

        mailbox = Mailbox[tuple[Head, bytes]](f"trade-ros1{topic}", tell, most=most, end_s=0.0)

        def came(head: Head, body: bytes) -> None:
            mailbox.put((head, body))

        opened = self._link.open(head, came, most)
        return opened, (opened.close, mailbox.close)

    # --- services

    def serve(self, name: str, type_name: str, answer: Answer, *, stops: bool = False) -> Closable:
        head = {**service_head(self._types, type_name), "op": "serve", "name": _name(name, "service")}
        if self._link.names("serve", name):
            raise ConfigurationError(where=name, problem="is offered already by this node")
        served = Served(self._types, name, type_name, answer, self._link.reply, stops=stops)
        opened = self._link.open(head, served.came)
        return self._closing((served.close, opened.close))

    def call(
        self, name: str, type_name: str, request: Mapping[str, Any], timeout_s: float, *, stops: bool = False
    ) -> Message:
        asked, response = self._types.parts(type_name)
        head = {**service_head(self._types, type_name), "op": "call", "name": _name(name, "service")}
        _, body = self._link.ask(name, head, self._types.to_bytes(asked, request), timeout_s, stops=stops)
        return self._types.from_bytes(response, body)

    # --- actions

    def act(self, name: str, type_name: str, do: Callable[[Goal], Outcome], refuse: Refuse | None = None) -> Closable:
        return self._closing((ActionServer(self, _name(name, "action"), type_name, do, refuse).close,))

    def pursue(
        self, name: str, type_name: str, goal: Mapping[str, Any], feedback: Callable[[Message], object] | None = None
    ) -> ActionGoal:
        with self._lock:
            client = self._clients.get(name)
            if client is None or client.type_name != type_name:
                client = self._clients[name] = ActionClient(self, _name(name, "action"), type_name)
        return client.pursue(goal, feedback)

    def connected(self, what: str, opened: Iterable[Opened], timeout_s: float) -> list[set[str]]:
        """The nodes at the other ends of each of these topics. Raises RosUnreachable."""
        asked = {"op": "connected", "ids": [one.number for one in opened]}
        return [set(names) for names in self._link.ask(what, asked, b"", timeout_s)[0]]

    # --- parameters, nodes

    def parameters(self, node: str, timeout_s: float) -> dict[str, Any]:
        value, _ = self._link.ask(node, {"op": "parameters", "name": node}, b"", timeout_s)
        return _flat(cast("Message", value)) if isinstance(value, dict) else {"": value}

    def set_parameter(self, node: str, name: str, value: Any, timeout_s: float) -> None:
        at = f"{node.rstrip('/')}/{name.lstrip('/')}"
        if not isinstance(value, (bool, int, float, str, list, dict)):
            raise RosRefused(what=at, problem=f"{value!r} cannot be a parameter of ROS")
        self._link.ask(at, {"op": "set_parameter", "name": at, "value": value}, b"", timeout_s)

    def watch_nodes(self, listener: NodeListener) -> Closable:
        return self._closing((self._nodes.watch(listener),))

    def close(self) -> None:
        with self._lock:
            opened, self._open = self._open, set()
            clients, self._clients = self._clients, {}
        for client in clients.values():
            client.cancel_all()
        for one in (*opened, *clients.values()):
            one.close()
        self._link.close()

    # ---

    def _topic(self, op: str, topic: str, type_name: str) -> Head:
        head = {**message_head(self._types, type_name), "op": op, "name": _name(topic, "topic")}
        for other in self._link.names("publish", topic) + self._link.names("subscribe", topic):
            if other["md5"] != head["md5"]:
                raise ConfigurationError(where=topic, problem=f"is open as {other['type']} already in this node")
        return head

    def _node(self, name: str, there: bool) -> None:
        self._nodes.report(name, there)
        if not there:
            for client in list(self._clients.values()):
                client.gone(name)

    def _closing(self, steps: tuple[Callable[[], object], ...]) -> Closable:
        closing = _Closing((*steps, lambda: self._open.discard(closing)))
        with self._lock:
            self._open.add(closing)
        return closing


def _nothing(head: Head, body: bytes) -> None:
    """Ignores frames of a published topic."""


def _name(name: str, of: str) -> str:
    if not _NAME.fullmatch(name):
        raise ConfigurationError(
            where=f"ROS {of} {name!r}", problem="is not a global name of ROS, such as /arm/joint_states"
        )
    return name


def _flat(tree: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    """Parameters by their full names; an empty namespace has none."""
    found: dict[str, Any] = {}
    for name, value in tree.items():
        found.update(
            _flat(cast("Message", value), f"{above}{name}/") if isinstance(value, dict) else {f"{above}{name}": value}
        )
    return found
