"""A network in memory: which nodes reach each other, the messages between them, and simulated faults."""

import itertools
import math
import random
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

from trade.transport.base import Answer, ChannelClosed, Message, Question
from trade.transport.memory.clock import Clock
from trade.transport.memory.keys import meet
from trade.transport.memory.links import Delay, Link, LinkDirection, MessageKind
from trade.transport.memory.node import MemoryQuestions, Node
from trade.transport.memory.traffic import Arrive, Traffic
from trade.transport.memory.wait_clock import MovedWaitClock


@dataclass(frozen=True, slots=True)
class InFlightMessage:
    """A message between two transports, as a tap sees it: once when it is sent, and once when it has arrived."""

    kind: MessageKind
    source: str
    """Name of the sending node."""
    target: str
    key: str
    payload: bytes | None
    arrived: bool


_MOST_ROUTES: Final = 4096

Tap = Callable[[InFlightMessage], None]


class Network:
    """The network on which the memory transports of one system meet.

    Messages arrive at once, before ``put`` returns, unless their link has a delay or is cut. Nothing else takes time:
    queries (``ask``, ``present``) and replies arrive at once wherever the link has not been given up, and a new node is
    linked with all others. The network has its own time, which stops until it is moved: see ``clock`` and ``traffic``.
    ``waits`` is the clock of deadlines, leases and lock waits: it runs, and a test can move it ahead.

    A link that is cut (``partition``) keeps what is sent on it, as a TCP connection would. If it heals within the
    lease, it delivers all of that. Otherwise the link is given up: signs of life disappear on both sides and the kept
    messages are lost; when it heals, the signs reappear. Single messages are lost where ``lose`` selects them.

    Args:
        seed: seed of the generator of jitter.
        lease_s: the time after which a cut link is given up.
        beat_s: see ``Transport``, in seconds of the real clock; no beats by default.
        clock: the clock to use instead of a new one at zero.
    """

    def __init__(
        self, *, seed: int = 0, lease_s: float = 2.0, beat_s: float = math.inf, clock: Clock | None = None
    ) -> None:
        self.clock: Final = clock or Clock()
        self.waits: Final = MovedWaitClock()
        self.sent: Final[Counter[MessageKind]] = Counter()
        """How many messages of each kind were sent from one transport to another."""
        self.lock: Final = threading.RLock()
        self.changed: Final = threading.Condition(self.lock)
        """Notified when a query may have ended."""
        self.beat_s: Final = beat_s
        self._lease_s = lease_s
        self.traffic: Final = Traffic(self.clock, self._under_lock)
        self._random = random.Random(seed)  # noqa: S311 - no secret
        self._delay = Delay()
        self._nodes: list[Node] = []
        self._named: dict[str, Node] = {}
        self._links: dict[Node, dict[Node, Link]] = {}
        """By node and neighbour: a send does not search the links of other nodes."""
        self._routes: dict[str, list[Node]] = {}
        """The nodes that receive a key, in the order in which they joined; each new subscription clears this cache."""
        self._taps: list[Tap] = []
        self._losing: list[Callable[[InFlightMessage], bool]] = []
        self._numbers = itertools.count(1)

    def _under_lock(self, arrive: Arrive) -> None:
        with self.lock:
            arrive()

    # --- membership

    def join(self, name: str) -> Node:
        """Add a node that is linked with all others; it knows their signs of life when this returns."""
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
                        MessageKind.RISE, other, node, Message(key, b""), _seeing(node, other, token, key), at_once=True
                    )
            return node

    def node(self, name: str) -> Node | None:
        """The node that joined last under a name, even if it has ended."""
        return self._named.get(name)

    def leave(self, node: Node) -> None:
        """End a node in order: its earlier messages arrive, then all its signs of life disappear. Idempotent."""
        with self.lock:
            if node.closed:
                return
            self._nodes.remove(node)
            node.end()
            for link in self._links_of(node):
                other = link.far_end(node)
                self.pass_on(MessageKind.LEAVE, node, other, Message("", None), lambda link=link: self._forget(link))

    def kill(self, node: Node) -> None:
        """End a node like a killed process: its messages that have not arrived are lost. Idempotent."""
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

    # --- messages

    def next_number(self) -> int:
        """A number that is unique in this network."""
        return next(self._numbers)

    def spread(self, source: Node, message: Message, kind: MessageKind) -> None:
        """Send to all nodes that would read the message; readers of the source itself get it at once."""
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

    def clear_routes(self) -> None:
        """Clear the routes after a subscription changed. Used under the network's lock."""
        self._routes.clear()

    def show(self, source: Node, token: int, key: str) -> None:
        """Show a sign of life to all nodes."""
        with self.lock:
            _check_open(source)
            source.tokens[token] = key
            source.see(source, token, key)
            for target in self._others(source):
                self.pass_on(MessageKind.RISE, source, target, Message(key, b""), _seeing(target, source, token, key))

    def hide(self, source: Node, token: int) -> None:
        """Withdraw a sign of life. Idempotent."""
        with self.lock:
            key = source.tokens.pop(token, None)
            if key is None:
                return
            source.lose_sight(token)
            for target in self._others(source):
                self.pass_on(MessageKind.FALL, source, target, Message(key, None), _losing(target, token))

    def ask(self, source: Node, patterns: Sequence[str], timeout_s: float) -> list[Answer]:
        """Query all others; wait, by the real clock, until all that are not lost have replied."""
        with self.lock:
            _check_open(source)
            questions = [
                _Query(self, source, target, pattern, asked)
                for pattern in patterns
                for target in self._others(source)
                for asked in target.asked
                if meet(pattern, asked.pattern)
            ]
            for question in questions:
                question.send()
            self.changed.wait_for(lambda: source.closed or all(question.ended for question in questions), timeout_s)
            _check_open(source)
            answers: dict[Node, Answer] = {}
            for question in questions:
                if question.collected.messages:
                    answer = answers.setdefault(question.target, Answer(question.collected.who, []))
                    answer.messages.extend(question.collected.messages)
            return list(answers.values())

    def linked(self, one: Node, other: Node) -> bool:
        """Whether a link between two open nodes is up."""
        link = self._link(one, other)
        return link is not None and link.up and not (one.closed or other.closed)

    def _others(self, node: Node) -> list[Node]:
        """The nodes to which it has a link that is up."""
        others = [link.far_end(node) for link in self._links_of(node) if link.up]
        return [other for other in others if not other.closed]

    def pass_on(
        self, kind: MessageKind, source: Node, target: Node, message: Message, arrive: Arrive, *, at_once: bool = False
    ) -> None:
        """Send one message over one link; a tap may have removed the link meanwhile."""
        self.sent[kind] += 1
        passage = InFlightMessage(kind, source.name, target.name, message.key, message.payload, arrived=False)
        self._call_taps(passage)
        if any(loses(passage) for loses in list(self._losing)):
            return
        link = self._link(source, target)
        if link is None or not link.up:
            return

        def arrived() -> None:
            arrive()
            self._call_taps(InFlightMessage(kind, source.name, target.name, message.key, message.payload, arrived=True))

        arrived() if at_once else link.ways[source].send(kind, arrived)

    def tap(self, callback: Tap) -> Callable[[], None]:
        """Show a function every message between two transports, before it is sent and after it has arrived.

        The function runs under the network's lock, on the thread that sends or moves the time: it may kill, partition
        and heal, but neither wait, nor move the time, nor use a container.

        Returns:
            A function that removes the tap.
        """
        self._taps.append(callback)
        return lambda: self._taps.remove(callback)

    def lose(self, which: Callable[[InFlightMessage], bool]) -> Callable[[], None]:
        """Drop selected messages in flight; both ends stay linked.

        Args:
            which: decides before a message is sent whether it is lost. The same restrictions apply as for a tap.

        Returns:
            A function that ends the loss.
        """
        self._losing.append(which)
        return lambda: self._losing.remove(which)

    def _call_taps(self, passage: InFlightMessage) -> None:
        for tap in list(self._taps):
            tap(passage)

    # --- faults

    def delay(self, least_s: float, *, jitter_s: float = 0.0, between: tuple[Node, Node] | None = None) -> None:
        """Delay messages by ``least_s`` plus up to ``jitter_s``, on one link or on all, including later ones."""
        delay = Delay(least_s, jitter_s)
        with self.lock:
            if between is None:
                self._delay = delay
            for link in self._all_links() if between is None else [self._links[between[0]][between[1]]]:
                for way in link.ways.values():
                    way.delay = delay

    def partition(self, one: Node, other: Node, *, one_way: bool = False) -> None:
        """Cut a link; ``one_way``: only from the first node to the second. A cut beyond the lease ends the link."""
        with self.lock:
            link = self._link(one, other)
            if link is None:
                return
            for source in (one,) if one_way else (one, other):
                way = link.ways[source]
                if not way.cut:
                    way.cut, way.cuts = True, way.cuts + 1
                    self._expire_later(link, way)

    def _expire_later(self, link: Link, way: LinkDirection) -> None:
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
        """Heal the link of two nodes, all links of one node, or all links."""
        with self.lock:
            named = {node for node in (one, other) if node is not None}
            for link in [link for link in self._all_links() if named <= {*link.ends}]:
                for way in link.ways.values():
                    way.cut = False
                    way.resume()
                if not link.up and self._link(*link.ends) is link:
                    self._link_again(link)

    def _link_again(self, link: Link) -> None:
        """Show each node the signs of life of the other."""
        link.up = True
        for source in link.ends:
            target = link.far_end(source)
            for token, key in list(source.tokens.items()):
                self.pass_on(MessageKind.RISE, source, target, Message(key, b""), _seeing(target, source, token, key))


class _Query(Question):
    """One query to one node."""

    def __init__(self, network: Network, source: Node, target: Node, pattern: str, queryable: MemoryQuestions) -> None:
        self.collected = Answer(f"{target.name}-{network.next_number()}", [])
        self._network = network
        self._source = source
        self.target = target
        self._pattern = pattern
        self._queryable = queryable
        self._closed = False

    def send(self) -> None:
        """Send the query. Used under the network's lock."""
        message = Message(self._pattern, None)
        self._network.pass_on(
            MessageKind.ASK, self._source, self.target, message, lambda: self._queryable.take(self), at_once=True
        )

    @property
    def ended(self) -> bool:
        """Whether no more replies will come; used under the network's lock."""
        return self._closed or not self._network.linked(self._source, self.target)

    def answer(self, key: str, payload: bytes) -> None:
        with self._network.lock:
            if self.ended:
                raise ChannelClosed
            if meet(self._pattern, key):
                message = Message(key, payload)
                self._network.pass_on(
                    MessageKind.ANSWER,
                    self.target,
                    self._source,
                    message,
                    lambda: self.collected.messages.append(message),
                    at_once=True,
                )

    def close(self) -> None:
        with self._network.lock:
            self._closed = True
            self._network.changed.notify_all()


def _check_open(node: Node) -> None:
    if node.closed:
        raise ChannelClosed


def _taking(target: Node, message: Message) -> Arrive:
    return lambda: target.take(message, own=False)


def _seeing(target: Node, owner: Node, token: int, key: str) -> Arrive:
    return lambda: target.see(owner, token, key)


def _losing(target: Node, token: int) -> Arrive:
    return lambda: target.lose_sight(token)
