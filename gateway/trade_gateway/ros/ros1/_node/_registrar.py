"""Reconciles the node's open topics and services with the master, periodically; rospy registers them only once.

Nothing waits for an unreachable master, and a restarted master receives all registrations again.
"""

# pyright: basic, reportMissingImports=false

from __future__ import annotations

import threading
import time
from contextlib import suppress
from typing import Any, Callable, Tuple

from rospy.core import ROSRPC
from rospy.impl.registration import get_service_manager, get_topic_manager
from rospy.impl.tcpros_base import get_tcpros_server_address

from ._master import Refused, Unreachable, ask, is_reachable
from ._peers import Peers

_EVERY_S = 0.5
_CONNECT_AGAIN_S = 3.0
_REGISTER = {"topic": "registerPublisher", "heard": "registerSubscriber", "service": "registerService"}
_UNREGISTER = {"topic": "unregisterPublisher", "heard": "unregisterSubscriber", "service": "unregisterService"}

Entry = Tuple[str, str]
"""A kind (a key of the tables above) and a name."""


class Registrar:
    """Keeps the registrations at the master, and learns from it which nodes exist."""

    def __init__(self, master: str, node: str, handler: Any, peers: Peers, healthy: Callable[[str], object]) -> None:
        self._master = master
        self._node = node
        self._handler = handler
        self._peers = peers
        self._healthy = healthy
        self._done: dict[Entry, Any] = {}
        self._asked_s: dict[tuple[str, str], float] = {}
        self._turn = threading.Lock()
        self._wake = threading.Event()
        self._ended = False
        threading.Thread(target=self._run, name="registrar", daemon=True).start()

    def wake(self) -> None:
        """Reports that something was opened or closed."""
        self._wake.set()

    def end(self, timeout_s: float) -> None:
        """Withdraws all registrations from the master."""
        deadline = time.monotonic() + timeout_s
        self._ended = True
        if not self._turn.acquire(timeout=timeout_s):
            return
        try:
            for entry in list(self._done):
                if time.monotonic() < deadline:
                    self._unregister(entry)
        except (Unreachable, Refused):
            pass
        finally:
            self._turn.release()

    def _run(self) -> None:
        while not self._ended:
            self._wake.clear()
            with self._turn:
                self._healthy(self._problem())
            self._wake.wait(_EVERY_S)

    def _problem(self) -> str:
        try:
            wanted = _open()
            state = ask(self._master, "getSystemState", self._node)
            other = self._other()
            if other:
                return f"there is another node {self._node}, at {other}; give this one another name"
            self._register(wanted, _listed(state, self._node))
            self._see(state)
            self._connect(state[0])
        except Unreachable as problem:
            return f"no master at {self._master}: {problem}"
        except Refused as problem:
            return f"the master at {self._master}: {problem}"
        return ""

    def _other(self) -> str:
        """The address of another node with this name."""
        if self._ended:
            return ""
        try:
            uri = ask(self._master, "lookupNode", self._node, self._node)
        except Refused:
            return ""
        return uri if uri != self._handler.uri and is_reachable(uri, self._node) else ""

    def _register(self, wanted: dict[Entry, tuple[str, Any]], listed: set[Entry]) -> None:
        for entry, (what, opened) in wanted.items():
            if self._ended:
                return
            if self._done.get(entry) is opened and entry in listed:
                continue
            if self._done.pop(entry, opened) is not opened:
                self._unregister(entry)  # reopened meanwhile: its peers must be notified so that they reconnect
            kind, name = entry
            publishers = ask(self._master, _REGISTER[kind], self._node, name, what, self._handler.uri)
            self._done[entry] = opened
            if kind == "heard":
                self._handler.reg_man.publisher_update(name, publishers)
        for entry in set(self._done) - set(_open()):
            self._unregister(entry)
            del self._done[entry]

    def _unregister(self, entry: Entry) -> None:
        kind, name = entry
        # a service is unregistered by its address, which all services of this node share
        uri = ROSRPC + "{}:{}".format(*get_tcpros_server_address()) if kind == "service" else self._handler.uri
        ask(self._master, _UNREGISTER[kind], self._node, name, uri)

    def _see(self, state: Any) -> None:
        names = {name for entries in state for _, nodes in entries for name in nodes} - {self._node}
        for name in names:
            if self._peers.seeks(name) and not self._ended:
                with suppress(Refused):  # it has left since
                    self._peers.at(name, ask(self._master, "lookupNode", self._node, name))
        self._peers.only(names)

    def _connect(self, publishers: list[Any]) -> None:
        """Reconnects a broken connection whose ends are both alive: rospy waits for a change at the master."""
        now = time.monotonic()
        self._asked_s = {key: when for key, when in self._asked_s.items() if now - when < _CONNECT_AGAIN_S}
        for topic, names in publishers:
            heard = get_topic_manager().get_subscriber_impl(topic)
            uris = [self._peers.uri(name) for name in names] if heard else []
            lost = [uri for uri in uris if uri and not heard.has_connection(uri) and (topic, uri) not in self._asked_s]
            if lost:
                self._asked_s.update({(topic, uri): now for uri in lost})
                self._handler.reg_man.publisher_update(topic, lost)


def _open() -> dict[Entry, tuple[str, Any]]:
    """What this node has open: its type (for a service its address) and its object."""
    topics, services = get_topic_manager(), get_service_manager()
    with topics.lock:
        found = {("topic", name): (made.type, made) for name, made in topics.pubs.items()}
        found.update({("heard", name): (made.type, made) for name, made in topics.subs.items()})
    with services.lock:
        found.update({("service", name): (made.uri, made) for name, made in services.map.items()})
    return found


def _listed(state: Any, node: str) -> set[Entry]:
    found: set[Entry] = set()
    for kind, entries in zip(("topic", "heard", "service"), state):
        found.update((kind, name) for name, nodes in entries if node in nodes)
    return found
