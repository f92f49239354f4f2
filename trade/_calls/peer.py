"""A peer: another container as callers see it, with its clock, the routes to it, and the pending replies."""

import threading
import time
from collections.abc import Callable
from typing import Final

from msgspec import Struct

from trade._calls.arguments import ArgumentEncoder
from trade._calls.local_path import LocalPeer, LocalStarter
from trade._calls.slot import Sent, Slot
from trade._threads.scheduler import NEVER
from trade.protocol.keys import Address, call_key
from trade.protocol.messages import EMPTY, PROTOCOL, Call, Reply, encode_message
from trade.transport.base import Channel, Publisher, Transport

_DRIFT: Final = 200e-6
"""The largest drift between two monotonic clocks (quartz is specified to 100 ppm)."""


class Peer:
    """Another container as callers see it: whether it is reachable, and the offset of its clock."""

    def __init__(self, address: Address, *, lost: bool = False, local: LocalPeer | None = None) -> None:
        self.address = address
        self.local = local
        """Connections to it on this host; None without the local path."""
        self.answers_on = f"reply/{address.identity}/"
        """The prefix of the keys of its answers."""
        self.lost = lost
        self.returns = 0
        """How often its sign of life has appeared."""
        self.unarrived: set[int] = set()
        """Started calls that may not have arrived yet: a call must not overtake them."""
        self.answers = 0
        """The number of calls that it has answered."""
        self._low_ns = -NEVER
        self._high_ns = NEVER
        self._at_ns = 0

    @property
    def clock_known(self) -> bool:
        return self._low_ns > -NEVER

    def heard(self, clock_ns: int, sent_ns: int, received_ns: int) -> None:
        """Takes its clock's reading ``clock_ns``, from a time between sending the request and receiving the reply."""
        slack = (received_ns - self._at_ns) * _DRIFT
        low = max(self._low_ns - slack, clock_ns - received_ns)
        high = min(self._high_ns + slack, clock_ns - sent_ns)
        if low > high:  # one of the clocks was set or suspended: earlier readings are void
            low, high = clock_ns - received_ns, clock_ns - sent_ns
        self._low_ns, self._high_ns, self._at_ns = low, high, received_ns
        self.answers += 1

    def expiry_ns(self, deadline_ns: int) -> int | None:
        """A local deadline in its clock, never later than intended; None while its clock is unknown."""
        low, slack = self._low_ns, (time.monotonic_ns() - self._at_ns) * _DRIFT
        return int(deadline_ns + low - slack) if low > -NEVER else None

    def close(self) -> None:
        """Closes the connections to it that no call uses."""
        if self.local is not None:
            self.local.close()


class Route(Struct, frozen=True):
    """How calls reach one provider of another container; all of them share it."""

    peer: Peer
    publisher: Publisher
    key: bytes
    """The key that it publishes on."""
    stops: bool
    """Whether it is for stops."""
    arguments: ArgumentEncoder | None = None
    """Encodes arguments that are values; None if they are bytes already."""
    middleware: bool = False
    """Whether it leads to the middleware's own services."""

    def encode(self, call: Call) -> bytes:
        """The call as bytes. Raises InvalidArgument, NotSerialisable, TooLarge."""
        return encode_message(call) if self.arguments is None else self.arguments.encode_call(call)

    def encode_parts(self, call: Call) -> tuple[bytes, ...]:
        """The same in parts, of which a large one is not copied."""
        return (encode_message(call),) if self.arguments is None else self.arguments.encode_parts(call)


OnReply = Callable[[Reply], None]


class ReplySlot(Slot):
    """A reply channel that one caller at a time borrows."""

    __slots__ = ("_transport", "_wake_key", "channel", "name")

    def __init__(self, name: str, transport: Transport, wake_key: str, channel: Channel) -> None:
        super().__init__()
        self.name = name
        self.channel = channel
        self._transport = transport
        self._wake_key = wake_key

    def end(self, call_id: int, status: int) -> None:
        self.ended_status = status
        self.ended_id = call_id
        self._transport.wake(self._wake_key, encode_message(ended(call_id, status)))


def ended(call_id: int, status: int) -> Reply:
    """The reply that this container gives itself."""
    return Reply(PROTOCOL, call_id, status, 0, EMPTY)


class Pending:
    """A started call that waits for its reply without a thread."""

    __slots__ = ("again", "deadline_ns", "grants", "on_progress", "on_reply", "peer", "sent", "sent_ns", "starter")

    def __init__(
        self,
        peer: Peer,
        deadline_ns: int,
        on_reply: OnReply,
        on_progress: OnReply | None,
        sent: Sent,
        starter: LocalStarter | None = None,
        *,
        grants: bool = False,
    ) -> None:
        self.peer = peer
        self.grants = grants
        """Whether its answer may grant a lock, or renew one."""
        self.deadline_ns = deadline_ns
        self.on_reply = on_reply
        self.on_progress = on_progress
        self.sent = sent
        self.sent_ns = time.monotonic_ns()
        self.starter = starter
        """The connection that carries it; None: the transport does."""
        self.again = False
        """Whether it was sent again, after its connection had broken."""


class CallPublishers:
    """The publishers of calls: one for each provider and priority, closed with the provider."""

    def __init__(self, transport: Transport, identity: str) -> None:
        self._transport = transport
        self._identity = identity
        self._lock = threading.Lock()
        self._publishers: dict[str, Publisher] = {}
        """The publishers, by key."""
        self._urgent: set[Publisher] = set()
        """The publishers of stops."""

    def get(self, key: str, *, stop: bool) -> Publisher:
        """The publisher of a provider's key. Raises ChannelClosed if the transport is closed."""
        with self._lock:
            found = self._publishers.get(key)
            if found is None:
                found = self._publishers[key] = self._transport.publish(key, urgent=stop)
                if stop:
                    self._urgent.add(found)
            return found

    def of_stops(self, publisher: Publisher) -> bool:
        """Whether a publisher sends stops."""
        return publisher in self._urgent

    def forget(self, callee: Address, domain: str, provider: str) -> None:
        """Closes the publishers of a provider that is gone."""
        keys = [call_key(self._identity, callee, domain, provider, stop=stop) for stop in (False, True)]
        with self._lock:
            gone = [self._publishers.pop(key, None) for key in keys]
            self._urgent.difference_update(gone)
        for publisher in gone:
            if publisher is not None:
                publisher.close()

    def close(self) -> None:
        """Closes all publishers."""
        for publisher in list(self._publishers.values()):
            publisher.close()
