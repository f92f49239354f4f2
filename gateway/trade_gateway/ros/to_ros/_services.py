"""TRADE services, and locks over them, as ROS services."""

from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

from trade import Constraint, Container, Handle, Lock, where
from trade.errors import ConfigurationError
from trade_gateway.clients._clients import Client
from trade_gateway.ros._file import LockService, ServiceEntry
from trade_gateway.ros._graph import Answer, Closable, Graph, RosRefused
from trade_gateway.ros._mapping_sync import Place, absent_name, named_services
from trade_gateway.ros._nodes import UNKNOWN, Nodes
from trade_gateway.ros_messages._conversion import RequestMapping, ResponseMapping, ros_path
from trade_gateway.ros_messages._types import Message

_SET_BOOL: Final = "std_srvs/srv/SetBool"


class _ClientLock(NamedTuple):
    """The lock of a node."""

    client: Client
    """The session that holds it."""
    lock: Lock
    name: str
    """Its name at the client."""


class ServicesToRos:
    """``[[to_ros.service]]``: a call in ROS becomes a call in the session of the calling node."""

    def __init__(self, entry: ServiceEntry, graph: Graph, nodes: Nodes) -> None:
        """Raises ConfigurationError: the type is not known."""
        self._entry = entry
        self._graph = graph
        self._nodes = nodes
        self._request, response = graph.types.parts(entry.type)
        self._response = ResponseMapping(graph.types, response)

    @property
    def of(self) -> Constraint:
        group, _, name = self._entry.service.rpartition(".")
        return where(group=self._entry.group or group or None, name=name or None)

    @property
    def absent(self) -> tuple[str, str]:
        entry = self._entry
        if entry.service:
            return absent_name(entry.service, f"{entry.type} {entry.name}".strip())
        return entry.group, f"no services that fit {entry.type}"

    def places(self, found: Sequence[Handle]) -> Iterable[tuple[Place, Handle]]:
        entry = self._entry
        if entry.service:
            for handle in named_services(entry.service, found):
                yield Place("service", entry.name or ros_path(handle.key.domain, handle.name)), handle
            return
        for handle in found:
            if handle.name in (entry.names or (handle.name,)) and self._fits(handle):
                yield Place("service", ros_path(handle.key.domain, handle.name)), handle

    def _fits(self, handle: Handle) -> bool:
        try:
            self._asked(handle)
        except ConfigurationError:
            return False
        return True

    def _asked(self, handle: Handle) -> RequestMapping:
        asked = RequestMapping(self._graph.types, self._request, handle, self._entry.args)
        if asked.unused:
            problem = f"has the unused fields {', '.join(asked.unused)}; the service is {handle.signature}"
            raise ConfigurationError(where=f"{self._entry.type} for {handle.label}", problem=problem)
        return asked

    def open(self, place: Place, handle: Handle) -> Closable:
        asked, response, deadline_s = self._asked(handle), self._response, self._entry.deadline_s

        stops = handle.effect == "stop"

        def answer(request: Message, client: str, came_at: float) -> Message:
            guest = self._nodes.guest(client, came_at, stops=stops)
            return response(guest.call(handle, asked(request), deadline_s, came_at))

        return self._graph.serve(place.name, self._entry.type, answering(response, answer), stops=stops)


class LocksToRos:
    """``[[to_ros.lock]]``: a node takes and releases a lock in its session; the end of the node releases it."""

    def __init__(self, entry: LockService, graph: Graph, nodes: Nodes, container: Container) -> None:
        self._entry = entry
        self._graph = graph
        self._nodes = nodes
        self._container = container
        self._locks: dict[str, _ClientLock] = {}
        """By node."""

    @property
    def of(self) -> Constraint:
        return where(group=self._entry.group)

    @property
    def absent(self) -> tuple[str, str]:
        return self._entry.group, "nothing to lock"

    def places(self, found: Sequence[Handle]) -> Iterable[tuple[Place, Handle]]:
        first = next((handle for handle in found if handle.effect == "actuate"), None)
        if first is not None:
            name = self._entry.name or ros_path(self._entry.group, "lock")
            yield Place("service", name, f"a lock over {self._entry.group}"), first

    def open(self, place: Place, handle: Handle) -> Closable:  # noqa: ARG002 - the lock covers a whole group
        response = ResponseMapping(self._graph.types, self._graph.types.parts(_SET_BOOL)[1])

        def answer(request: Message, client: str, came_at: float) -> Message:
            text = self._take(client, came_at) if request["data"] else self._give_back(client)
            return {"success": True, "message": text}

        return self._graph.serve(place.name, _SET_BOOL, answering(response, answer))

    def _take(self, client_name: str, came_at: float) -> str:
        if client_name == UNKNOWN:
            problem = "ROS does not identify the caller, so its end would be invisible. A lock needs a known node"
            raise RosRefused(what=f"lock of {self._entry.group}", problem=problem)
        guest, before = self._nodes.guest(client_name, came_at), self._locks.get(client_name)
        client, wanted = guest.client, where(group=self._entry.group)
        if before is not None and before.client is client and before.lock.held:
            return f"it has {', '.join(before.lock.resources)}"
        self._give_back(client_name)
        client.locking()
        with client.session.use():
            purpose = f"of {client_name}, a node of ROS"
            lock = self._container.lock(wanted, purpose=purpose, wait_s=self._entry.wait_s).acquire()
        handles = [one for one in self._container.services(wanted) if one.effect == "actuate"]
        taken = self._locks[client_name] = _ClientLock(client, lock, client.keep(lock, handles))
        client.when_closed(lambda: self._forget(client_name, taken))
        client.session.check()
        return ", ".join(lock.resources)

    def _forget(self, client: str, taken: _ClientLock) -> None:
        if self._locks.get(client) is taken:
            del self._locks[client]

    def _give_back(self, client: str) -> str:
        taken = self._locks.pop(client, None)
        given_back = taken is not None and not taken.client.closed and taken.client.unlock(taken.name)
        return "released" if given_back else "it had none"


def answering(response: ResponseMapping, answer: Answer) -> Answer:
    """Wraps an answer to report errors in the response, if its type can."""

    def guarded(request: Message, client: str, came_at: float) -> Message:
        try:
            return answer(request, client, came_at)
        except Exception as error:  # noqa: BLE001 - reported to the node, whatever it is
            return response.failed(error)

    return guarded
