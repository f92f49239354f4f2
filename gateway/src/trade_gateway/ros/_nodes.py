"""Nodes of ROS as clients: each has a session of its own, which ends when the node does (S03).

ROS tells of nodes that go. If it is lost itself nobody does, and then all of them count as gone after a short grace.
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

__all__ = ["UNKNOWN", "Guest", "NodeLocks", "Nodes"]


class _HeldLock:
    def __init__(self, name: str) -> None:
        self.name = name
        self.users = 1


class NodeLocks:
    """Of one node. What it has locked itself is used and stays its own."""

    def __init__(self, container: Container, client: Client) -> None:
        self._container = container
        self._client = client
        self._guard = threading.Lock()
        self._grips: dict[frozenset[Place], _HeldLock] = {}

    @contextmanager
    def hold(self, handles: Sequence[Handle], purpose: str, wait_s: float) -> Generator[None]:
        """Have services for the node alone inside.

        Args:
            handles: those that move something.
            purpose: as others are told.
            wait_s: how long to wait for others.

        Raises:
            LockedByOther: somebody else has one of them, or moves it.
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
"""Whoever ROS does not tell apart: they are one client together."""
_LOOK_EVERY_S: Final = 0.1
_UNSEEN_S: Final = 5.0
"""Who was heard but is not among the nodes that ROS tells of is gone so long after it was heard last."""
_FORGOTTEN_S: Final = 2.0
"""So long nothing is done for a node that has ended: what comes then was sent before."""
_REMEMBERED_S: Final = 60.0
"""What came before a node ended is refused for so long; nothing waits longer for its turn."""
_WAIT_S: Final = 0.5
"""For a lock: what somebody has just let go of."""
_LATE_S: Final = 5.0
"""Beyond a call's deadline, when its end must have been told."""


class Guest:
    """One node of ROS; its methods wait."""

    def __init__(self, container: Container, client: Client, who: str) -> None:
        self._container = container
        self.client: Final = client
        self.who: Final = who
        """Its name; empty: nobody knows."""
        self.grips: Final = NodeLocks(container, client)
        self.heard_at = time.monotonic()
        self.stopped_at = 0.0
        """When its last stop came: what came before that must not begin any more (S08)."""

    @property
    def named(self) -> str:
        """For people."""
        return self.who or "a node of ROS that is not known"

    def call(self, handle: Handle, args: dict[str, Any], deadline_s: float, came_at: float) -> Any:
        """Call a service of ours and wait; what moves is under a lock meanwhile. Raises as `begin`, and as the call."""
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
        """Call without waiting, under the locks there are.

        Args:
            handle: what to call.
            args: by name.
            deadline_s: how long it may take.
            came_at: when the node asked for it (``time.monotonic()``), before it waited for anything; None: the bridge
                itself asks.
            admitted: what `Client.admit` said when it was asked for; by default that is now.

        Raises:
            Cancelled: a stop was asked for meanwhile.
            SessionEnded: the node is gone.
        """
        client = self.client
        if handle.effect == "stop" and came_at is not None:
            self.stopped_at = max(self.stopped_at, came_at)
        number = client.admit(handle) if admitted is None else admitted
        if handle.effect == "actuate" and came_at is not None and came_at <= self.stopped_at:
            raise Cancelled(service=handle.label)

        def start() -> Run:
            return self._container.begin(handle, (), args, deadline_s)

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
    """Those that have asked for something.

    Args:
        container: the bridge's.
        graph: the ROS system.
        grace_s: how long that may be lost before all nodes count as gone.
        told: called with what is wrong with the ROS system, or nothing, whenever that changes.
    """

    def __init__(self, container: Container, graph: Graph, grace_s: float, told: Callable[[str], object]) -> None:
        self._container = container
        self._graph = graph
        self._grace_s = grace_s
        self._tell = told
        self._guests: dict[str, Guest] = {}
        self._there: set[str] = set()
        self._gone: dict[str, float] = {}
        """When which has ended, lately."""
        self._guard = threading.Lock()
        self._lost = ""
        self._lost_at: float | None = None
        self._closing = threading.Event()
        self._watch = graph.watch_nodes(self._node)
        self._thread = threading.Thread(target=self._look_on, name="trade-ros-nodes", daemon=True)
        self._thread.start()

    def guest(self, who: str, came_at: float, *, stops: bool = False) -> Guest:
        """The client that a node is.

        Args:
            who: its name, as ROS says it.
            came_at: when it asked for something, by ``time.monotonic()``.
            stops: it wants to stop something, which it always may.

        Raises:
            RosUnreachable: nobody would see it die, or it has since; or the bridge is leaving.
        """
        with self._guard:
            if self._closing.is_set() and not stops:
                raise RosUnreachable(what="the bridge", problem="it is leaving; nothing is begun any more")
            if self._lost and not stops:
                problem = f"{self._lost}; nobody would see {who or 'a node'} die, so nothing is done for it until then"
                raise RosUnreachable(what="ROS", problem=problem)
            if self._is_of_the_dead(who, came_at) and not stops:
                raise RosUnreachable(what=who, problem="it has ended; what was still under way from it is not done")
            guest = self._guests.get(who)
            if guest is None or guest.client.closed:
                guest = self._guests[who] = self._opened(who)
            guest.heard_at = time.monotonic()
            return guest

    def _is_of_the_dead(self, who: str, came_at: float) -> bool:
        gone_at = self._gone.get(who)
        if gone_at is None:
            return False
        return came_at <= gone_at or (who not in self._there and time.monotonic() - gone_at < _FORGOTTEN_S)

    def _opened(self, who: str) -> Guest:
        session = self._container.open_session(who.strip("/") or "unknown")
        return Guest(self._container, Client(self._container.address.identity, session, lambda _: None), who)

    def names(self) -> list[str]:
        """Of the nodes that have a session now."""
        with self._guard:
            return sorted(guest.named for guest in self._guests.values() if not guest.client.closed)

    # --- who is gone

    def _node(self, name: str, there: bool) -> None:
        with self._guard:
            (self._there.add if there else self._there.discard)(name)
            gone = None if there else self._guests.pop(name, None)
            if not there:
                self._gone[name] = time.monotonic()
        if gone is not None:
            _logger.info("%s is gone: what it moved stops, its locks fall", name)
            gone.client.close()

    def _look_on(self) -> None:
        while not self._closing.wait(_LOOK_EVERY_S):
            try:
                self._look()
            except Exception:
                _logger.exception("nodes of ROS could not be looked after")

    def _look(self) -> None:
        problem, now = self._graph.healthy, time.monotonic()
        self._lost_at = None if not problem else now if self._lost_at is None else self._lost_at
        lost = problem if self._lost_at is not None and now - self._lost_at >= self._grace_s else ""
        with self._guard:
            self._gone = {name: at for name, at in self._gone.items() if now - at < _REMEMBERED_S}
            changed, self._lost = bool(lost) != bool(self._lost), lost
            all_of_them = changed and bool(lost)  # later there are only some that stop something
            gone = [one for one in self._guests.values() if all_of_them or self._unseen(one, now)]
            for guest in gone:
                del self._guests[guest.who]
        for guest in gone:
            guest.client.close()
        if changed:
            self._tell(lost)

    def _unseen(self, guest: Guest, now: float) -> bool:
        unseen = bool(self._lost) or guest.who not in (UNKNOWN, *self._there)
        return unseen and now - guest.heard_at > _UNSEEN_S

    def close(self) -> None:
        """All count as gone. Idempotent."""
        self._closing.set()
        self._watch.close()
        self._thread.join()
        with self._guard:
            guests, self._guests = list(self._guests.values()), {}
        for guest in guests:
            guest.client.close()
