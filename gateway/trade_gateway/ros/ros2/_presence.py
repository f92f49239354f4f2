# pyright: reportUnknownMemberType=false
"""Presence by liveliness tokens: the nodes, what they offer, and which node an endpoint belongs to.

The tokens of a process that ends or is killed vanish at once with its connection to the router. The router notices a
frozen or disconnected one after the lease of its session, 60 s in the configuration that ROS 2 ships. Without a
router, no node is visible.
"""

import threading
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Final

import zenoh

from trade_gateway.ros._graph import NodeListener
from trade_gateway.ros._mailbox import Mailbox
from trade_gateway.ros.ros2._link import Link
from trade_gateway.ros.ros2._names import TokenContent, TokenKind, every_token, gid, read_token

_INTRODUCTION_S: Final = 0.5
"""How long a first message waits for the token of its sender, which may arrive later."""
_PAUSE_S: Final = 5.0
"""Pause after an unknown sender before the next is waited for, so that unknown ones do not delay the others (S07)."""
_MOST_STRANGERS: Final = 1024
_ENDED_S: Final = 10.0
"""How long the name of an ended endpoint is kept, for messages of it that still wait in a queue."""
_MOST_ENDED: Final = 4096


class NodeSubscription:
    """A subscription to the nodes."""

    def __init__(self, listener: NodeListener, end: "Callable[[NodeSubscription], None]") -> None:
        self._report = listener
        self._end = end
        self.mailbox: Final = Mailbox[tuple[str, bool]]("ros2 nodes", self._tell)

    def _tell(self, news: tuple[str, bool]) -> None:
        self._report(*news)

    def close(self) -> None:
        """Ends the subscription. Idempotent."""
        self._end(self)
        self.mailbox.close()


class Presence:
    """The nodes and endpoints of one domain, as the router announces them."""

    def __init__(self, link: Link, domain_id: int) -> None:
        self._own = link.id
        self._changed = threading.Condition()
        self._tokens: dict[str, TokenContent] = {}
        self._node_of: dict[bytes, str] = {}
        self._ended: dict[bytes, tuple[str, float]] = {}
        """Nodes of endpoints that ended, and until when they are kept; the oldest first."""
        self._nodes: Counter[str] = Counter()
        self._offered: Counter[tuple[TokenKind, str]] = Counter()
        self._strangers: set[bytes] = set()
        self._waits_from = 0.0
        self._watching: list[NodeSubscription] = []
        self._declared = link.declare(partial(self._listen, every_token(domain_id)))

    def introduce(self, endpoint_gid: bytes, node: str) -> None:
        """Adds an endpoint of the bridge's own node."""
        with self._changed:
            self._node_of[endpoint_gid] = node

    def node_of(self, endpoint_gid: bytes) -> str:
        """The name of an endpoint's node; empty without a token. May wait, once for each unknown endpoint."""
        with self._changed:
            now = time.monotonic()
            known = self._named(endpoint_gid) or endpoint_gid in self._strangers
            if not known and now >= self._waits_from:
                self._wait_for(endpoint_gid, now + _INTRODUCTION_S)
            return self._named(endpoint_gid)

    def known(self, endpoint_gid: bytes) -> str:
        """The same without waiting: also empty if its token has not arrived yet."""
        with self._changed:
            return self._named(endpoint_gid)

    def offered(self, kind: TokenKind, name: str) -> bool:
        """Whether another session has such an endpoint."""
        with self._changed:
            return self._offered[kind, name] > 0

    def watch(self, listener: NodeListener) -> NodeSubscription:
        """See `Graph.watch_nodes`; the bridge's own node is not reported."""
        watching = NodeSubscription(listener, self._unwatch)
        with self._changed:
            self._watching.append(watching)
            for node in self._nodes:
                watching.mailbox.put((node, True))
        return watching

    def close(self) -> None:
        """Stops listening. Idempotent."""
        self._declared.close()
        with self._changed:
            watching = list(self._watching)
        for each in watching:
            each.close()

    def _unwatch(self, watching: NodeSubscription) -> None:
        with self._changed:
            if watching in self._watching:
                self._watching.remove(watching)

    def _named(self, endpoint_gid: bytes) -> str:
        there = self._node_of.get(endpoint_gid)
        if there is not None:
            return there
        ended, until = self._ended.get(endpoint_gid, ("", 0.0))
        return ended if time.monotonic() < until else ""

    def _wait_for(self, endpoint_gid: bytes, deadline: float) -> None:
        while not self._named(endpoint_gid):
            left_s = deadline - time.monotonic()
            if left_s <= 0:
                self._waits_from = time.monotonic() + _PAUSE_S
                if len(self._strangers) < _MOST_STRANGERS:
                    self._strangers.add(endpoint_gid)
                return
            self._changed.wait(left_s)

    def _listen(self, every: str, session: zenoh.Session) -> list[zenoh.Subscriber[None]]:
        return [session.liveliness().declare_subscriber(every, self._heard, history=True)]

    def _heard(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        seen = read_token(key)
        if seen is None or seen.session == self._own:
            return
        with self._changed:
            if sample.kind == zenoh.SampleKind.PUT:
                self._came(key, seen)
            else:
                self._went(key)
            self._changed.notify_all()

    def _came(self, key: str, seen: TokenContent) -> None:
        if key in self._tokens:
            return
        self._tokens[key] = seen
        if seen.kind is TokenKind.NODE:
            self._nodes[seen.node] += 1
            if self._nodes[seen.node] == 1:
                self._tell(seen.node, there=True)
            return
        endpoint_gid = gid(key)
        self._offered[seen.kind, seen.name] += 1
        self._node_of[endpoint_gid] = seen.node
        self._ended.pop(endpoint_gid, None)
        self._strangers.discard(endpoint_gid)

    def _went(self, key: str) -> None:
        seen = self._tokens.pop(key, None)
        if seen is None:
            return
        if seen.kind is not TokenKind.NODE:
            self._offered[seen.kind, seen.name] -= 1
            if not self._offered[seen.kind, seen.name]:
                del self._offered[seen.kind, seen.name]
            self._remember(gid(key))
            return
        self._nodes[seen.node] -= 1
        self._tell(seen.node, there=False)
        if self._nodes[seen.node]:
            # of two nodes with one name, one ended: report that, whichever remains
            self._tell(seen.node, there=True)
        else:
            del self._nodes[seen.node]

    def _remember(self, endpoint_gid: bytes) -> None:
        now = time.monotonic()
        self._ended[endpoint_gid] = self._node_of.pop(endpoint_gid), now + _ENDED_S
        for oldest, (_, until) in list(self._ended.items()):
            if until > now and len(self._ended) <= _MOST_ENDED:
                break
            del self._ended[oldest]

    def _tell(self, node: str, *, there: bool) -> None:
        for watching in self._watching:
            watching.mailbox.put((node, there))
