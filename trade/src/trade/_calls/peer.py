"""Another container as callers see it: its clock, how calls reach it, and where their replies wait."""

import math
import threading
import time
from collections.abc import Callable
from typing import Final

from msgspec import Struct

from trade._calls.arguments import ArgumentEncoder
from trade._protocol.keys import Address, call_key
from trade._protocol.messages import Call, Reply, encode_message
from trade._transport.base import Channel, Publisher, Transport

NEVER: Final = math.inf
_DRIFT: Final = 200e-6
"""Two monotonic clocks run apart at most this fast (quartz is specified to 100 ppm)."""


class Peer:
    """Another container as callers see it: whether it is there, and how its clock runs against ours."""

    def __init__(self, address: Address, *, lost: bool = False) -> None:
        self.address = address
        self.answers_on = f"reply/{address.identity}/"
        """How the keys of its answers begin."""
        self.lost = lost
        self._low_ns = -NEVER
        self._high_ns = NEVER
        self._at_ns = 0

    @property
    def clock_known(self) -> bool:
        return self._low_ns > -NEVER

    def heard(self, clock_ns: int, sent_ns: int, received_ns: int) -> None:
        """Its clock stood at ``clock_ns`` some time between our sending and our receiving."""
        slack = (received_ns - self._at_ns) * _DRIFT
        low = max(self._low_ns - slack, clock_ns - received_ns)
        high = min(self._high_ns + slack, clock_ns - sent_ns)
        if low > high:  # its clock or ours was set or stood still: what was known is void
            low, high = clock_ns - received_ns, clock_ns - sent_ns
        self._low_ns, self._high_ns, self._at_ns = low, high, received_ns

    def expiry_ns(self, deadline_ns: int) -> int | None:
        """Our deadline in its clock, never later than it is meant; None while the clock is unknown."""
        low, slack = self._low_ns, (time.monotonic_ns() - self._at_ns) * _DRIFT
        return int(deadline_ns + low - slack) if low > -NEVER else None


class Route(Struct, frozen=True):
    """How calls reach one provider of another container; made once for all of them."""

    peer: Peer
    publisher: Publisher
    arguments: ArgumentEncoder | None = None
    """Encodes arguments that are values; None: they are bytes already."""

    def encode(self, call: Call) -> bytes:
        """Raises InvalidArgument, NotSerialisable, TooLarge."""
        return encode_message(call) if self.arguments is None else self.arguments.encode_call(call)


OnReply = Callable[[Reply], None]

Waiting = tuple[int, Peer, int]
"""Call id, who is to answer, deadline: swapped as a whole, so that whoever ends a wait ends the one it looked at."""


Sent = tuple[Publisher, bytes]
"""What was put where, to be put once more if the link had gone."""


class ReplySlot:
    """A reply channel lent to one caller at a time."""

    __slots__ = ("channel", "ended_id", "name", "sent", "waiting", "wake_key")

    def __init__(self, name: str, wake_key: str, channel: Channel) -> None:
        self.name = name
        self.wake_key = wake_key
        self.channel = channel
        self.waiting: Waiting | None = None
        self.sent: Sent | None = None
        self.ended_id = 0
        """The call whose wait was ended from our side last."""


class Pending:
    """A started call that waits for its answer without a thread."""

    __slots__ = ("deadline_ns", "on_progress", "on_reply", "peer", "sent", "sent_ns")

    def __init__(
        self, peer: Peer, deadline_ns: int, on_reply: OnReply, on_progress: OnReply | None, sent: Sent
    ) -> None:
        self.peer = peer
        self.deadline_ns = deadline_ns
        self.on_reply = on_reply
        self.on_progress = on_progress
        self.sent = sent
        self.sent_ns = time.monotonic_ns()


class CallPublishers:
    """Each is made once, and let go of with its provider."""

    def __init__(self, transport: Transport, identity: str) -> None:
        self._transport = transport
        self._identity = identity
        self._lock = threading.Lock()
        self._made: dict[str, Publisher] = {}
        """By key."""
        self._urgent: set[Publisher] = set()
        """Those of stops."""

    def get(self, callee: Address, domain: str, provider: str, *, stop: bool) -> Publisher:
        """The one of a provider. Raises ChannelClosed: everything is closed."""
        key = call_key(self._identity, callee, domain, provider, stop=stop)
        with self._lock:
            found = self._made.get(key)
            if found is None:
                found = self._made[key] = self._transport.publish(key, urgent=stop)
                if stop:
                    self._urgent.add(found)
            return found

    def of_stops(self, publisher: Publisher) -> bool:
        """Whether what is put there are stops."""
        return publisher in self._urgent

    def forget(self, callee: Address, domain: str, provider: str) -> None:
        """A provider is gone."""
        keys = [call_key(self._identity, callee, domain, provider, stop=stop) for stop in (False, True)]
        with self._lock:
            gone = [self._made.pop(key, None) for key in keys]
            self._urgent.difference_update(gone)
        for publisher in gone:
            if publisher is not None:
                publisher.close()

    def close(self) -> None:
        """Let go of all."""
        for publisher in list(self._made.values()):
            publisher.close()
