"""Which nodes are there, for whoever watches them."""

import threading
from collections.abc import Callable

from trade_gateway.ros._graph import NodeTold
from trade_gateway.ros.ros1._lane import Lane

__all__ = ["Nodes"]


class Nodes:
    """The nodes that can be seen. Each watcher is told on a thread of its own, in order, and misses nothing."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._there: set[str] = set()
        self._watchers: dict[int, tuple[NodeTold, Lane]] = {}
        self._watched = 0

    def told(self, name: str, there: bool) -> None:
        """A node came, or went."""
        with self._lock:
            if there == (name in self._there):
                return
            (self._there.add if there else self._there.discard)(name)
            for watcher in self._watchers.values():
                _tell(watcher, name, there)

    def none(self) -> None:
        """Nothing can be seen any more."""
        for name in sorted(self._there):
            self.told(name, False)

    def watch(self, told: NodeTold) -> Callable[[], None]:
        """Tell of those that are there, and of every change; returns what ends it."""
        lane = Lane("trade-ros1-nodes")
        with self._lock:
            self._watched += 1
            number = self._watched
            self._watchers[number] = told, lane
            for name in sorted(self._there):
                _tell((told, lane), name, True)

        def end() -> None:
            with self._lock:
                self._watchers.pop(number, None)
            lane.close()

        return end


def _tell(watcher: tuple[NodeTold, Lane], name: str, there: bool) -> None:
    told, lane = watcher
    lane.put(lambda: told(name, there))
