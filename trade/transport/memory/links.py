"""A bidirectional link between two transports of a memory network, with delays and cuts."""

import enum
import itertools
import random
from dataclasses import dataclass
from typing import Final

from trade.transport.memory.node import Node
from trade.transport.memory.traffic import Arrive, Traffic


class MessageKind(enum.Enum):
    """The kind of a message between two transports."""

    PUT = "put"
    URGENT = "urgent"
    DROPPABLE = "droppable"
    """Urgent, and dropped where it would have to wait."""
    ANNOUNCE = "announce"
    RISE = "rise"
    """A sign of life appears."""
    FALL = "fall"
    """A sign of life is withdrawn."""
    ASK = "ask"
    """A query for the current announcements."""
    ANSWER = "answer"
    """One current announcement."""
    LEAVE = "leave"
    """The transport closes."""


class Lane(enum.Enum):
    """Messages of one lane keep their order; messages of different lanes may overtake each other."""

    URGENT = enum.auto()
    DATA = enum.auto()
    ANNOUNCEMENTS = enum.auto()
    PRESENCE = enum.auto()


_LANES: Final = {
    MessageKind.PUT: Lane.DATA,
    MessageKind.URGENT: Lane.URGENT,
    MessageKind.DROPPABLE: Lane.URGENT,
    MessageKind.ANNOUNCE: Lane.ANNOUNCEMENTS,
    MessageKind.RISE: Lane.PRESENCE,
    MessageKind.FALL: Lane.PRESENCE,
    MessageKind.LEAVE: Lane.PRESENCE,
}


@dataclass(frozen=True, slots=True)
class Delay:
    """How long messages travel: ``least_s``, plus up to ``jitter_s``, evenly distributed."""

    least_s: float = 0.0
    jitter_s: float = 0.0

    def draw_ns(self, generator: random.Random) -> int:
        """The travel time of one message."""
        jitter_s = generator.uniform(0.0, self.jitter_s) if self.jitter_s else 0.0
        return round((self.least_s + jitter_s) * 1e9)


class LinkDirection:
    """One direction of a link, used under the network's lock.

    Messages sent during a cut wait, as on a TCP connection, and arrive after the link heals, unless the link is given
    up first.
    """

    def __init__(self, traffic: Traffic, generator: random.Random, delay: Delay) -> None:
        self.delay = delay
        self.cut = False
        self.cuts = 0
        """The number of cuts so far; distinguishes one cut from the next."""
        self._traffic = traffic
        self._random = generator
        self._held: list[tuple[MessageKind, Arrive]] = []
        self._connections = itertools.count()
        self.drop()

    def send(self, kind: MessageKind, arrive: Arrive) -> None:
        """Deliver a message after its delay, after earlier messages of its lane; LEAVE waits for all lanes."""
        if self.cut:
            if kind is not MessageKind.DROPPABLE:
                self._held.append((kind, arrive))
            return
        behind = list(Lane) if kind is MessageKind.LEAVE else [_LANES[kind]]
        now_ns = self._traffic.clock.monotonic_ns()
        due_ns = max(now_ns + self.delay.draw_ns(self._random), *(self._last_ns[lane] for lane in behind), 0)
        if due_ns <= now_ns and not any(self._under_way[lane] for lane in behind):
            arrive()
        else:
            self._send_at(due_ns, _LANES[kind], arrive)

    def _send_at(self, due_ns: int, lane: Lane, arrive: Arrive) -> None:
        connection = self._connection
        self._last_ns[lane] = due_ns
        self._under_way[lane] += 1

        def pass_on() -> None:
            if connection == self._connection:
                self._under_way[lane] -= 1
                arrive()

        self._traffic.later(due_ns, pass_on, urgent=lane is Lane.URGENT)

    def resume(self) -> None:
        """Send what waited for the end of a cut."""
        held, self._held = self._held, []
        for kind, arrive in held:
            self.send(kind, arrive)

    def drop(self) -> None:
        """Reset: drop everything that is in flight or waits."""
        self._connection = next(self._connections)
        self._held.clear()
        self._under_way = dict.fromkeys(Lane, 0)
        self._last_ns = dict.fromkeys(Lane, 0)


class Link:
    """Two nodes and the two ways between them."""

    def __init__(self, one: Node, other: Node, traffic: Traffic, generator: random.Random, delay: Delay) -> None:
        self.ends: Final = (one, other)
        self.ways: Final = {node: LinkDirection(traffic, generator, delay) for node in self.ends}
        """By the node that each direction starts from."""
        self.up = True

    def drop(self) -> None:
        self.up = False
        for way in self.ways.values():
            way.drop()

    def far_end(self, node: Node) -> Node:
        """The node at the other end."""
        one, other = self.ends
        return other if node is one else one
