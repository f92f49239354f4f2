"""A slot: what one caller at a time borrows to wait for a reply."""

from trade.transport.base import Publisher

Waiting = tuple[int, object, int]
"""Call id, callee and deadline: replaced as a whole, so that a thread ends the same wait that it has examined."""

Sent = tuple[Publisher, bytes]
"""A sent message and its publisher, to send it again after a lost link."""


class Slot:
    """What one caller at a time borrows to wait for a reply."""

    __slots__ = ("ended_id", "ended_status", "sent", "waiting")

    def __init__(self) -> None:
        self.waiting: Waiting | None = None
        self.sent: Sent | None = None
        """What was sent on the transport."""
        self.ended_id = 0
        """The last call whose wait this container ended itself."""
        self.ended_status = 0

    def end(self, call_id: int, status: int) -> None:
        """Ends the wait for a call, from another thread."""
        raise NotImplementedError
