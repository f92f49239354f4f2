"""What a call that is under way keeps at its caller: a reply channel that a thread waits on, or whom to tell."""

import time
from collections.abc import Callable

from trade._calls.peer import Peer
from trade._protocol.messages import Reply
from trade._transport.base import Channel, Publisher

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
