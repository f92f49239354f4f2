"""ROS nodes as clients of TRADE: each has its own session, which ends when the node does (S03).

ROS reports nodes that end. If ROS itself is lost, no reports arrive, and all nodes count as gone after a short grace.
"""

import logging
import threading
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from typing import Any, Final

from trade import Container, Handle, Run
from trade.errors import Cancelled
from trade_gateway.clients._clients import Client, Place, places
from trade_gateway.ros._graph import Graph, RosUnreachable


class _HeldLock:
    def __init__(self, name: str) -> None:
        self.name = name
        self.users = 1


class NodeLocks:
    """The locks of one node. Locks that the node took itself are used and kept."""

    def __init__(self, container: Container, client: Client) -> None:
        self._container = container
        self._client = client
        self._guard = threading.Lock()
        self._grips: dict[frozenset[Place], _HeldLock] = {}

    @contextmanager
    def hold(self, handles: Sequence[Handle], purpose: str, wait_s: float) -> Generator[None]:
        """Holds locks on services for the node inside the context.

        Args:
            handles: the services that move something.
            purpose: the purpose shown to others.
            wait_s: how long to wait for other owners, in seconds.

        Raises:
            LockedByOther: another client has locked one of them, or moves it.
            TradeError: see `trade.Container.lock`.
        """
        taken = self._take(handles, purpose, wait_s)
        try:
            yield
        finally:
            if taken is not None:
                self._give_back(taken)

    def _take(self, handles: Sequence[Handle], purpose: str, wait_s: float) -> frozenset[Place] | None:
        wanted = frozenset(places(handles))
        with self._guard:
            for covered, grip in self._grips.items():
                if covered >= wanted:
                    grip.users += 1
                    return covered
            if all(self._client.has_locked(handle) for handle in handles):
                return None
            self._client.locking()
            with self._client.session.use():
                lock = self._container.lock(handles, purpose=purpose, wait_s=wait_s).acquire()
            self._grips[wanted] = _HeldLock(self._client.keep(lock, list(handles)))
        return wanted

    def _give_back(self, taken: frozenset[Place]) -> None:
        with self._guard:
            grip = self._grips[taken]
            grip.users -= 1
            last = grip.users == 0
            if last:
                del self._grips[taken]
        if last:
            self._client.unlock(grip.name)


_logger = logging.getLogger("trade")

UNKNOWN: Final = ""
"""The name of all clients that ROS does not identify; they share one client of TRADE."""
_LOOK_EVERY_S: Final = 0.1
_UNSEEN_S: Final = 5.0
"""Time after the last message until a node that ROS does not list counts as gone."""
_FORGOTTEN_S: Final = 2.0
"""Time during which requests of an ended node are refused, as they were sent before its end."""
_REMEMBERED_S: Final = 60.0
"""How long the end of a node is remembered; no request waits longer for its turn."""
_WAIT_S: Final = 0.5
"""Wait for a lock that another client has just released."""
_LATE_S: Final = 5.0
"""Time after a call's deadline by which its end must be known."""


class NodeClient:
    """The client that represents one ROS node; its methods wait."""

    def __init__(self, container: Container, client: Client, node_name: str) -> None:
        self._container = container
        self.client: Final = client
        self.who: Final = node_name
        """Its name; empty if unknown."""
        self.grips: Final = NodeLocks(container, client)
        self.heard_at = time.monotonic()
        self.stopped_at = 0.0
        """When its last stop arrived; earlier requests must not begin any more (S08)."""

    @property
    def named(self) -> str:
        """Its name for people."""
        return self.who or "an unknown node of ROS"

    def call(self, handle: Handle, args: dict[str, Any], deadline_s: float, came_at: float) -> Any:
        """Calls a TRADE service and waits, with locks for what moves. Raises as `begin`, and as the call."""
        if handle.effect != "actuate":
            return self._ended(self.begin(handle, args, deadline_s, came_at), deadline_s)
        admitted = self.client.admit(handle)
        with self.grips.hold([handle], f"a call of {self.named}", _WAIT_S):
            return self._ended(self.begin(handle, args, deadline_s, came_at, admitted), deadline_s)

    def begin(
        self,
        handle: Handle,
        args: dict[str, Any],
        deadline_s: float,
        came_at: float | None,
        admitted: int | None = None,
    ) -> Run:
        """Starts a call without waiting, under the current locks.

        Args:
            handle: what to call.
            args: by name.
            deadline_s: the call's deadline in seconds.
            came_at: arrival of the node's request (``time.monotonic()``), before any wait; None: the bridge itself
                makes the call.
            admitted: what `Client.admit` returned on arrival; by default it is called now.

        Raises:
            Cancelled: a stop was requested meanwhile.
            SessionEnded: the node is gone.
        """
        client = self.client
        if handle.effect == "stop" and came_at is not None:
            self.stopped_at = max(self.stopped_at, came_at)
        number = client.admit(handle) if admitted is None else admitted
        if handle.effect == "actuate" and came_at is not None and came_at <= self.stopped_at:
            raise Cancelled(service=handle.label)

        def start() -> Run:
            return self._container.client.begin(handle, (), args, deadline_s)

        with client.speaking():
            if handle.effect == "stop":
                client.stopping(number, handle, start)
            elif handle.effect == "actuate" and client.overtaken(number):
                raise Cancelled(service=handle.label)
            run = start()
            if handle.effect == "actuate":
                client.stop_again(number)
        if handle.effect != "stop":
            client.note(run)
        return run

    def _ended(self, run: Run, deadline_s: float) -> Any:
        try:
            return run.result(deadline_s + _LATE_S)
        finally:
            if not run.done():
                self.client.cancel(run)


class Nodes:
    """The nodes that have made a request.

    Args:
        container: the bridge's.
        graph: the ROS system.
        grace_s: how long ROS may be lost before all nodes count as gone, in seconds.
        changed: receives ROS's problem, or an empty text, at each change.
    """

    def __init__(self, container: Container, graph: Graph, grace_s: float, changed: Callable[[str], object]) -> None:
        self._container = container
        self._graph = graph
        self._grace_s = grace_s
        self._tell = changed
        self._guests: dict[str, NodeClient] = {}
        self._there: set[str] = set()
        self._gone: dict[str, float] = {}
        """When recently ended nodes ended."""
        self._guard = threading.Lock()
        self._lost = ""
        self._lost_at: float | None = None
        self._closing = threading.Event()
        self._watch = graph.watch_nodes(self._node)
        self._thread = threading.Thread(target=self._look_on, name="trade-ros-nodes", daemon=True)
        self._thread.start()

    def guest(self, client: str, came_at: float, *, stops: bool = False) -> NodeClient:
        """Returns the client that represents a node.

        Args:
            client: its name, from ROS.
            came_at: arrival of its request, by ``time.monotonic()``.
            stops: whether it wants to stop something, which is always allowed.

        Raises:
            RosUnreachable: the node's end would be invisible, or it has ended, or the bridge is shutting down.
        """
        with self._guard:
            if self._closing.is_set() and not stops:
                raise RosUnreachable(what="the bridge", problem="it is shutting down and begins no calls")
            if self._lost and not stops:
                problem = f"{self._lost}; the end of {client or 'a node'} would be invisible, so its request is refused"
                raise RosUnreachable(what="ROS", problem=problem)
            if self._is_of_the_dead(client, came_at) and not stops:
                raise RosUnreachable(what=client, problem="it has ended; its pending requests are not executed")
            guest = self._guests.get(client)
            if guest is None or guest.client.closed:
                guest = self._guests[client] = self._opened(client)
            guest.heard_at = time.monotonic()
            return guest

    def _is_of_the_dead(self, client: str, came_at: float) -> bool:
        gone_at = self._gone.get(client)
        if gone_at is None:
            return False
        return came_at <= gone_at or (client not in self._there and time.monotonic() - gone_at < _FORGOTTEN_S)

    def _opened(self, client: str) -> NodeClient:
        session = self._container.open_session(client.strip("/") or "unknown")
        return NodeClient(self._container, Client(self._container.address.identity, session, lambda _: None), client)

    def names(self) -> list[str]:
        """Names of the nodes that have a session now."""
        with self._guard:
            return sorted(guest.named for guest in self._guests.values() if not guest.client.closed)

    # --- nodes that are gone

    def _node(self, name: str, there: bool) -> None:
        with self._guard:
            (self._there.add if there else self._there.discard)(name)
            gone = None if there else self._guests.pop(name, None)
            if not there:
                self._gone[name] = time.monotonic()
        if gone is not None:
            _logger.info("%s is gone: its motion stops, and its locks are released", name)
            gone.client.close()

    def _look_on(self) -> None:
        while not self._closing.wait(_LOOK_EVERY_S):
            try:
                self._look()
            except Exception:
                _logger.exception("the check of ROS nodes failed")

    def _look(self) -> None:
        problem, now = self._graph.healthy, time.monotonic()
        self._lost_at = None if not problem else now if self._lost_at is None else self._lost_at
        lost = problem if self._lost_at is not None and now - self._lost_at >= self._grace_s else ""
        with self._guard:
            self._gone = {name: at for name, at in self._gone.items() if now - at < _REMEMBERED_S}
            changed, self._lost = bool(lost) != bool(self._lost), lost
            all_of_them = changed and bool(lost)  # later only nodes that stop something are left
            gone = [one for one in self._guests.values() if all_of_them or self._unseen(one, now)]
            for guest in gone:
                del self._guests[guest.who]
        for guest in gone:
            guest.client.close()
        if changed:
            self._tell(lost)

    def _unseen(self, guest: NodeClient, now: float) -> bool:
        unseen = bool(self._lost) or guest.who not in (UNKNOWN, *self._there)
        return unseen and now - guest.heard_at > _UNSEEN_S

    def close(self) -> None:
        """Ends the sessions of all nodes. Idempotent."""
        self._closing.set()
        self._watch.close()
        self._thread.join()
        with self._guard:
            guests, self._guests = list(self._guests.values()), {}
        for guest in guests:
            guest.client.close()
