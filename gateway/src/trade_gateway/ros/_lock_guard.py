"""Locks that the bridge takes for a node of ROS for as long as it moves something, so that locks hold against ROS."""

import threading
from collections.abc import Generator, Sequence
from contextlib import contextmanager

from trade import Container, Handle
from trade_gateway.clients._clients import Client, Place, places

__all__ = ["NodeLocks"]


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
