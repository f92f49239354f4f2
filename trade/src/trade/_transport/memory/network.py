"""A network in memory: which nodes can reach each other, what passes between them, and what goes wrong on the way."""

import itertools
import math
import random
import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from trade._transport.base import Answer, ChannelClosed, Message
from trade._transport.memory.clock import Clock
from trade._transport.memory.keys import meet
from trade._transport.memory.links import Delay, Kind, Link, Way
from trade._transport.memory.node import Node
from trade._transport.memory.questions import MemoryQuestion
from trade._transport.memory.traffic import Arrive, Traffic


@dataclass(frozen=True, slots=True)
class InFlightMessage:
    """A message between two transports, as a tap sees it: once when it is sent, once when it has arrived."""

    kind: Kind
    source: str
    """Name of the sender."""
    target: str
    key: str
    payload: bytes | None
    arrived: bool


_MOST_ROUTES: Final = 4096

Tap = Callable[[InFlightMessage], None]


class Network:
    """Where the memory transports of one system meet.

    Messages arrive at once, before ``put`` returns, unless their link has a delay or is cut. Nothing else takes time:
    questions (``ask``, ``present``) and answers arrive at once wherever the link has not been given up, and who joins
    is linked with all others. Time is the network's own and stands still until it is moved: see ``clock`` and
    ``traffic``. Containers keep their deadlines by the real clock.

    A link that is cut (``partition``) keeps what is put on it, as a TCP connection would. Healed within the lease, it
    delivers all of that. Else the link is given up: signs of life fall on both sides and what it kept is lost; when it
    heals, they rise again. Single messages are lost where ``lose`` says so.

    Args:
        seed: of the generator that draws jitter.
        lease_s: how long a cut is borne.
        beat_s: see ``Transport``, in seconds of the real clock; never, by default.
        clock: another one than a new one at zero.
    """

    def __init__(
        self, *, seed: int = 0, lease_s: float = 2.0, beat_s: float = math.inf, clock: Clock | None = None
    ) -> None:
        self.clock: Final = clock or Clock()
        self.sent: Final[Counter[Kind]] = Counter()
        """How many messages of each kind were sent from one transport to another."""
        self.lock: Final = threading.RLock()
        self.changed: Final = threading.Condition(self.lock)
        """Told when a question may have ended."""
        self.beat_s: Final = beat_s
        self._lease_s = lease_s
        self.traffic: Final = Traffic(self.clock, self._under_lock)
        self._random = random.Random(seed)  # noqa: S311 - no secret
        self._delay = Delay()
        self._nodes: list[Node] = []
        self._named: dict[str, Node] = {}
        self._links: dict[Node, dict[Node, Link]] = {}
        """Of each node, by its neighbour: what one sends costs nothing for the links of others."""
        self._routes: dict[str, list[Node]] = {}
        """Who hears a key, in the order in which they joined; of keys that were put on since anybody listened anew."""
        self._taps: list[Tap] = []
        self._losing: list[Callable[[InFlightMessage], bool]] = []
        self._numbers = itertools.count(1)

    def _under_lock(self, arrive: Arrive) -> None:
        with self.lock:
            arrive()

    # --- who is there

    def join(self, name: str) -> Node:
        """A new node, linked with all others; it knows their signs of life when this returns."""
        with self.lock:
            node = self._named[name] = Node(name)
            others, self._nodes = self._nodes, [*self._nodes, node]
            self._links[node] = {}
            for other in others:
                link = Link(node, other, self.traffic, self._random, self._delay)
                self._links[node][other] = self._links[other][node] = link
            for other in others:
                for token, key in list(other.tokens.items()):
                    self.pass_on(
                        Kind.RISE, other, node, Message(key, b""), _seeing(node, other, token, key), at_once=True
                    )
            return node

    def node(self, name: str) -> Node | None:
        """The one that joined last under a name, even if it has ended."""
        return self._named.get(name)

    def leave(self, node: Node) -> None:
        """An orderly end: what was sent before arrives, then all signs of life fall. Idempotent."""
        with self.lock:
            if node.closed:
                return
            self._nodes.remove(node)
            node.end()
            for link in self._links_of(node):
                other = link.far_end(node)
                self.pass_on(Kind.LEAVE, node, other, Message("", None), lambda link=link: self._forget(link))

    def kill(self, node: Node) -> None:
        """The end of a process without a goodbye: what it sent and has not arrived is lost. Idempotent."""
        with self.lock:
            if node.closed:
                return
            self._nodes.remove(node)
            node.end()
            for link in self._links_of(node):
                self._forget(link)

    def _links_of(self, node: Node) -> list[Link]:
        return list(self._links.get(node, {}).values())

    def _link(self, one: Node, other: Node) -> Link | None:
        return self._links.get(one, {}).get(other)

    def _all_links(self) -> list[Link]:
        return [link for node, links in self._links.items() for link in links.values() if link.ends[0] is node]

    def _forget(self, link: Link) -> None:
        self._unlink(link)
        self._give_up(link)

    def _unlink(self, link: Link) -> None:
        for node in link.ends:
            links = self._links.get(node, {})
            links.pop(link.far_end(node), None)
            if node.closed and not links:
                self._links.pop(node, None)

    # --- what passes

    def next_number(self) -> int:
        """A number nobody else in this network has."""
        return next(self._numbers)

    def spread(self, source: Node, message: Message, kind: Kind) -> None:
        """To all who would read it; to readers of the source itself at once."""
        with self.lock:
            _check_open(source)
            source.take(message, own=True)
            for target in self._hearers(message.key):
                if target is not source and self.linked(source, target):
                    self.pass_on(kind, source, target, message, _taking(target, message))

    def _hearers(self, key: str) -> list[Node]:
        found = self._routes.get(key)
        if found is None:
            if len(self._routes) >= _MOST_ROUTES:
                self._routes.clear()
            found = self._routes[key] = [node for node in self._nodes if node.hears(key)]
        return found

    def route_anew(self) -> None:
        """Somebody hears something else now. Used under the network's lock."""
        self._routes.clear()

    def show(self, source: Node, token: int, key: str) -> None:
        """A sign of life for everybody."""
        with self.lock:
            _check_open(source)
            source.tokens[token] = key
            source.see(source, token, key)
            for target in self._others(source):
                self.pass_on(Kind.RISE, source, target, Message(key, b""), _seeing(target, source, token, key))

    def hide(self, source: Node, token: int) -> None:
        """Take a sign of life down. Idempotent."""
        with self.lock:
            key = source.tokens.pop(token, None)
            if key is None:
                return
            source.lose_sight(token)
            for target in self._others(source):
                self.pass_on(Kind.FALL, source, target, Message(key, None), _losing(target, token))

    def ask(self, source: Node, pattern: str, timeout_s: float) -> list[Answer]:
        """Ask all others; wait, by the real clock, until those that are not lost have said all."""
        with self.lock:
            _check_open(source)
            questions = [
                MemoryQuestion(self, source, target, pattern, asked)
                for target in self._others(source)
                for asked in target.asked
                if meet(pattern, asked.pattern)
            ]
            for question in questions:
                question.send()
            self.changed.wait_for(lambda: source.closed or all(question.ended for question in questions), timeout_s)
            _check_open(source)
            return [question.said for question in questions if question.said.messages]

    def linked(self, one: Node, other: Node) -> bool:
        """Whether there is a link that is up, between two that are open."""
        link = self._link(one, other)
        return link is not None and link.up and not (one.closed or other.closed)

    def _others(self, node: Node) -> list[Node]:
        """Those it has a link to that is up."""
        others = [link.far_end(node) for link in self._links_of(node) if link.up]
        return [other for other in others if not other.closed]

    def pass_on(
        self, kind: Kind, source: Node, target: Node, message: Message, arrive: Arrive, *, at_once: bool = False
    ) -> None:
        """One message over one link; the link may be gone by the time a tap has seen it."""
        self.sent[kind] += 1
        passage = InFlightMessage(kind, source.name, target.name, message.key, message.payload, arrived=False)
        self._tell_taps(passage)
        if any(loses(passage) for loses in list(self._losing)):
            return
        link = self._link(source, target)
        if link is None or not link.up:
            return

        def arrived() -> None:
            arrive()
            self._tell_taps(InFlightMessage(kind, source.name, target.name, message.key, message.payload, arrived=True))

        arrived() if at_once else link.ways[source].send(kind, arrived)

    def tap(self, hear: Tap) -> Callable[[], None]:
        """Show somebody every message between two transports, before it is sent and after it arrived.

        It is told under the network's lock, on the thread that sends or moves the time: it may kill, partition and
        heal, but neither wait, nor move the time, nor use a container.

        Returns:
            A function that ends it.
        """
        self._taps.append(hear)
        return lambda: self._taps.remove(hear)

    def lose(self, which: Callable[[InFlightMessage], bool]) -> Callable[[], None]:
        """Lose messages on their way; both ends stay linked.

        Args:
            which: tells of a message before it is sent whether it is lost. It may do what a tap may.

        Returns:
            A function that ends it.
        """
        self._losing.append(which)
        return lambda: self._losing.remove(which)

    def _tell_taps(self, passage: InFlightMessage) -> None:
        for tap in list(self._taps):
            tap(passage)

    # --- what goes wrong

    def delay(self, least_s: float, *, jitter_s: float = 0.0, between: tuple[Node, Node] | None = None) -> None:
        """Let messages travel for ``least_s`` and up to ``jitter_s`` more, on one link or on all, later ones, too."""
        delay = Delay(least_s, jitter_s)
        with self.lock:
            if between is None:
                self._delay = delay
            for link in self._all_links() if between is None else [self._links[between[0]][between[1]]]:
                for way in link.ways.values():
                    way.delay = delay

    def partition(self, one: Node, other: Node, *, one_way: bool = False) -> None:
        """Cut a link; ``one_way``: only from the first to the second. A cut that outlasts the lease ends the link."""
        with self.lock:
            link = self._link(one, other)
            if link is None:
                return
            for source in (one,) if one_way else (one, other):
                way = link.ways[source]
                if not way.cut:
                    way.cut, way.cuts = True, way.cuts + 1
                    self._expire_later(link, way)

    def _expire_later(self, link: Link, way: Way) -> None:
        cut = way.cuts

        def expire() -> None:
            if way.cut and way.cuts == cut:
                self._give_up(link)

        due_ns = self.clock.monotonic_ns() + round(self._lease_s * 1e9)
        self.clock.at(due_ns, lambda: self._under_lock(expire))

    def _give_up(self, link: Link) -> None:
        if link.up:
            link.drop()
            one, other = link.ends
            one.lose_all_of(other)
            other.lose_all_of(one)
            if one.closed or other.closed:
                self._unlink(link)
            self.changed.notify_all()

    def heal(self, one: Node | None = None, other: Node | None = None) -> None:
        """Mend the link of two nodes, or all links of one, or all."""
        with self.lock:
            named = {node for node in (one, other) if node is not None}
            for link in [link for link in self._all_links() if named <= {*link.ends}]:
                for way in link.ways.values():
                    way.cut = False
                    way.resume()
                if not link.up and self._link(*link.ends) is link:
                    self._link_again(link)

    def _link_again(self, link: Link) -> None:
        """Both tell what they show."""
        link.up = True
        for source in link.ends:
            target = link.far_end(source)
            for token, key in list(source.tokens.items()):
                self.pass_on(Kind.RISE, source, target, Message(key, b""), _seeing(target, source, token, key))


def _check_open(node: Node) -> None:
    if node.closed:
        raise ChannelClosed


def _taking(target: Node, message: Message) -> Arrive:
    return lambda: target.take(message, own=False)


def _seeing(target: Node, owner: Node, token: int, key: str) -> Arrive:
    return lambda: target.see(owner, token, key)


def _losing(target: Node, token: int) -> Arrive:
    return lambda: target.lose_sight(token)
