"""A whole system in one process: containers on a network in memory, with faults on demand and no waiting for time."""

import contextlib
import math
import threading
import time
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Final

from trade._container.container import Container
from trade._settings import Settings
from trade._transport.memory import Clock, InFlightMessage, Kind, MemoryTransport, Network
from trade._transport.memory.node import Node

__all__ = ["MemorySystem", "memory_system"]

_TAKING_NOTE_S: Final = 10.0
_LOOK_AGAIN_S: Final = 0.0005

Named = Container | str
"""A container, or the name it was started under."""


class MemorySystem:
    """The containers of one test; made by `memory_system`.

    What one container sends arrives at the others at once, unless ``delay`` or ``partition`` say otherwise; their
    threads take note of it when they run, at the latest when ``settle`` returns. The network has a clock of its own,
    moved by ``advance`` and its kind alone; deadlines of calls go by the real one.
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
        """The container of that name, started if there is none or if it was killed or closed."""
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
        """End it as a killed process ends: everything at once, no goodbye.

        Its threads learn that the transport is closed; whatever provider still runs is nobody's any more.
        """
        self.network.kill(self._node(container))

    def close(self) -> None:
        """Close every container. Idempotent."""
        for container in reversed(self._every):
            container.close()

    # --- faults

    def partition(self, one: Named, other: Named, *, one_way: bool = False) -> None:
        """Cut what lies between two containers; ``one_way``: only what the first one sends.

        What is sent waits. After the lease (``advance``) the two lose each other and what has waited is lost.
        """
        self.network.partition(self._node(one), self._node(other), one_way=one_way)

    def heal(self, one: Named | None = None, other: Named | None = None) -> None:
        """End the partition of two containers, or all of one, or all."""
        nodes = [None if named is None else self._node(named) for named in (one, other)]
        self.network.heal(*nodes)

    def delay(self, least_s: float, *, jitter_s: float = 0.0, between: tuple[Named, Named] | None = None) -> None:
        """Let messages travel for ``least_s`` and up to ``jitter_s`` seconds more, drawn from the system's seed.

        Args:
            least_s: the shortest time, in seconds.
            jitter_s: how much longer it may take.
            between: two containers; none: all of them, also those to come.
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
        """Move the network's time on: messages arrive, leases end; containers have taken note when this returns."""
        self.clock.advance(duration_s)
        self._take_note()

    def settle(self) -> None:
        """Move the network's time on until nothing is under way and all containers have taken note of what arrived."""
        self.network.traffic.settle()
        self._take_note()

    def _take_note(self) -> None:
        deadline = time.monotonic() + _TAKING_NOTE_S
        while any(self._node(name).busy for name in list(self._containers)) or self._catching_up():
            if time.monotonic() > deadline:
                raise TimeoutError(f"a container has not taken note of what arrived within {_TAKING_NOTE_S} s")
            threading.Event().wait(_LOOK_AGAIN_S)

    def _catching_up(self) -> bool:
        return any(c.catching_up for name, c in list(self._containers.items()) if not self._node(name).closed)

    def drive(self, until: Callable[[], bool], limit_s: float = 10.0) -> None:
        """Move the network's time on, message by message, until something holds that containers bring about.

        Raises:
            TimeoutError: it does not hold after ``limit_s`` seconds of the real clock.
        """
        self.network.traffic.drive(until, limit_s)

    def flowing(self) -> contextlib.AbstractContextManager[None]:
        """While this lasts, time moves on by itself with the messages: blocking calls over delayed links return."""
        return self.network.traffic.flowing()

    # --- what passed

    def sent(self, *kinds: Kind) -> int:
        """How many messages went from one container to another so far, of these kinds or of all."""
        return sum(count for kind, count in self.network.sent.items() if kind in kinds or not kinds)

    def tap(self, hear: Callable[[InFlightMessage], None]) -> Callable[[], None]:
        """Hear of every message between two containers; see `Network.tap`. Returns what ends it."""
        return self.network.tap(hear)


@contextlib.contextmanager
def memory_system(
    *, seed: int = 0, lease_s: float = 2.0, beat_s: float = math.inf, state_dir: Path | None = None
) -> Generator[MemorySystem, None, None]:
    """A system in memory for one test; its containers are closed at the end.

    Args:
        seed: of the generator that draws jitter.
        lease_s: how long a partition lasts, on the network's clock, until containers lose each other.
        beat_s: how soon after an announcement a container says how far it is, in seconds of the real clock: who lost
            that asks then.
        state_dir: where containers keep what outlives them, such as open e-stops; none: nowhere.
    """
    system = MemorySystem(seed=seed, lease_s=lease_s, beat_s=beat_s, state_dir=state_dir)
    try:
        yield system
    finally:
        system.close()
