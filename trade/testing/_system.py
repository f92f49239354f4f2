"""A whole system in one process: containers on a network in memory, with faults on demand and a simulated clock."""

import contextlib
import math
import threading
import time
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Final

from trade._container.container import Container
from trade._settings import Settings
from trade.transport.memory import Clock, InFlightMessage, MemoryTransport, MessageKind, Network
from trade.transport.memory.node import Node

_TAKING_NOTE_S: Final = 10.0
_LOOK_AGAIN_S: Final = 0.0005

Named = Container | str
"""A container, or the name it was started with."""


class MemorySystem:
    """The containers of one test; made by `memory_system`.

    Messages arrive at other containers at once, unless ``delay`` or ``partition`` is set; the containers' threads
    handle them when they run, at the latest when ``settle`` returns. The network has its own clock, moved only by
    ``advance`` and its like. ``advance`` also moves notifications, lock waits and lock leases. Deadlines of calls use
    the real clock.
    """

    def __init__(
        self, *, seed: int = 0, lease_s: float = 2.0, beat_s: float = math.inf, state_dir: Path | None = None
    ) -> None:
        self._state_dir = state_dir
        self.network: Final = Network(seed=seed, lease_s=lease_s, beat_s=beat_s)
        self._containers: dict[str, Container] = {}
        self._every: list[Container] = []

    @property
    def clock(self) -> Clock:
        """The network's clock."""
        return self.network.clock

    # --- containers

    def container(self, name: str, *, identity: str = "tester", instantiable: Sequence[str] = ()) -> Container:
        """The container of a name, started if it does not run."""
        node = self.network.node(name)
        if node is not None and not node.closed:
            return self._containers[name]
        settings = Settings(
            system="memory",
            identity=identity,
            container=name,
            state_dir=self._state_dir,
            instantiable=tuple(instantiable),
        )
        container = Container(settings, transport=MemoryTransport(self.network, name))
        self._containers[name] = container
        self._every.append(container)
        return container

    def kill(self, container: Named) -> None:
        """End a container like a killed process: all at once, without a goodbye.

        Its threads learn that the transport is closed; providers that still run have lost their container.
        """
        self.network.kill(self._node(container))

    def close(self) -> None:
        """Close every container. Idempotent."""
        for container in reversed(self._every):
            container.close()

    # --- faults

    def partition(self, one: Named, other: Named, *, one_way: bool = False) -> None:
        """Cut the link between two containers; ``one_way``: only for messages of the first one.

        Messages wait. After the lease (``advance``) the two lose each other and the waiting messages are lost.
        """
        self.network.partition(self._node(one), self._node(other), one_way=one_way)

    def heal(self, one: Named | None = None, other: Named | None = None) -> None:
        """End the partition of two containers, of one from all, or of all."""
        nodes = [None if named is None else self._node(named) for named in (one, other)]
        self.network.heal(*nodes)

    def delay(self, least_s: float, *, jitter_s: float = 0.0, between: tuple[Named, Named] | None = None) -> None:
        """Delay messages by ``least_s`` and up to ``jitter_s`` seconds more, drawn from the system's seed.

        Args:
            least_s: the shortest time, in seconds.
            jitter_s: the largest additional time, in seconds.
            between: two containers; None: all, including later ones.
        """
        nodes = None if between is None else (self._node(between[0]), self._node(between[1]))
        self.network.delay(least_s, jitter_s=jitter_s, between=nodes)

    def lose(self, which: Callable[[InFlightMessage], bool]) -> Callable[[], None]:
        """Lose messages between two containers that stay linked; see `Network.lose`. Returns what ends it."""
        return self.network.lose(which)

    def _node(self, named: Named) -> Node:
        name = named if isinstance(named, str) else named.name
        node = self.network.node(name)
        if node is None:
            raise LookupError(f"no container {name!r} was started in this system; start it with container({name!r})")
        return node

    # --- time

    def advance(self, duration_s: float) -> None:
        """Advance the time of messages, deadlines, leases, lock waits and notifications, which are handled on return.

        Args:
            duration_s: by how much, in seconds.
        """
        self.network.waits.advance(duration_s, self._moved)

    def _moved(self, step_s: float) -> None:
        self.clock.advance(step_s)
        self._take_note()

    def settle(self) -> None:
        """Advance the network's time until no message is in flight and all containers have handled what arrived."""
        self.network.traffic.settle()
        self._take_note()

    def _take_note(self) -> None:
        deadline = time.monotonic() + _TAKING_NOTE_S
        while any(self._node(name).busy for name in list(self._containers)) or self._catching_up():
            if time.monotonic() > deadline:
                raise TimeoutError(f"a container has not handled what arrived within {_TAKING_NOTE_S} s")
            threading.Event().wait(_LOOK_AGAIN_S)

    def _catching_up(self) -> bool:
        return any(c.catching_up for name, c in list(self._containers.items()) if not self._node(name).closed)

    def drive(self, until: Callable[[], bool], limit_s: float = 10.0) -> None:
        """Advance the network's time, message by message, until a condition holds that containers bring about.

        Raises:
            TimeoutError: the condition does not hold after ``limit_s`` seconds of the real clock.
        """
        self.network.traffic.drive(until, limit_s)

    def flowing(self) -> contextlib.AbstractContextManager[None]:
        """Lets the time advance by itself with the messages: blocking calls over delayed links return."""
        return self.network.traffic.flowing()

    # --- messages

    def sent(self, *kinds: MessageKind) -> int:
        """The number of messages between containers so far, of these kinds or of all."""
        return sum(count for kind, count in self.network.sent.items() if kind in kinds or not kinds)

    def tap(self, callback: Callable[[InFlightMessage], None]) -> Callable[[], None]:
        """See every message between two containers; see `Network.tap`. Returns a function that ends it."""
        return self.network.tap(callback)


@contextlib.contextmanager
def memory_system(
    *, seed: int = 0, lease_s: float = 2.0, beat_s: float = math.inf, state_dir: Path | None = None
) -> Generator[MemorySystem, None, None]:
    """A system in memory for one test; its containers are closed at the end.

    Args:
        seed: seed of the generator of jitter.
        lease_s: how long a partition lasts, on the network's clock, until containers lose each other.
        beat_s: the interval of revision announcements, in seconds of the real clock: a container that missed an
            announcement queries after it.
        state_dir: folder for what outlives containers, such as open e-stops; None: nothing is kept.
    """
    system = MemorySystem(seed=seed, lease_s=lease_s, beat_s=beat_s, state_dir=state_dir)
    try:
        yield system
    finally:
        system.close()
