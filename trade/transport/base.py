"""The interface between the middleware and the transport that carries its bytes.

Five operations: publish, subscribe, announce (and answer queries), presence, close. Everything above is the
same on any implementation; ``zenoh`` is the real one.
"""

from abc import ABC, abstractmethod

from msgspec import Raw, Struct

from trade.transport.wait_clock import WaitClock


class ChannelClosed(Exception):
    """The channel, the publisher or the whole transport was closed; a reader's thread should end."""


class Message(Struct, frozen=True, gc=False):
    """Bytes and the key they were published on; a payload of None says that the value of the key is gone."""

    key: str
    payload: bytes | None


class Answer(Struct, frozen=True):
    """Everything that one transport replied to a query."""

    who: str
    """Distinguishes the transports that replied."""
    messages: list[Message]
    """In the order in which they were sent."""


class Channel(ABC):
    """A queue that the transport fills and our own threads read; several threads may read one."""

    @abstractmethod
    def receive(self) -> Message:
        """Wait for the next message. Raises ChannelClosed once closed. Ctrl-C interrupts it."""

    @abstractmethod
    def close(self) -> None:
        """Wake and end every reader. Idempotent."""


class Publisher(ABC):
    """A key declared once for publishing."""

    @abstractmethod
    def put(self, payload: bytes) -> None:
        """Send; waits up to a second for a stalled receiver, and never drops a message to a live one.

        Raises ChannelClosed once closed.
        """

    def put_parts(self, head: bytes, body: Raw | bytes) -> None:
        """Send a message in two parts, of which the second one is large: without a copy, where that is possible."""
        self.put(b"".join((head, body)))

    @abstractmethod
    def close(self) -> None:
        """Stop. Idempotent."""


class Question(ABC):
    """A query for the current announcements; the asking side waits until it is closed."""

    @abstractmethod
    def answer(self, key: str, payload: bytes) -> None:
        """Reply with one announcement; one that does not match the query is left out.

        May wait like a put. Raises ChannelClosed if the asking side can no longer receive it.
        """

    @abstractmethod
    def close(self) -> None:
        """End the reply. Idempotent."""


class Questions(ABC):
    """A queue of queries that the transport fills and our own threads read."""

    @abstractmethod
    def receive(self) -> Question:
        """Wait for the next query. Raises ChannelClosed once closed."""

    @abstractmethod
    def close(self) -> None:
        """Wake and end every reader. Idempotent."""


class Presence(ABC):
    """A sign of life that disappears when this process ends or becomes unreachable."""

    @abstractmethod
    def close(self) -> None:
        """Withdraw the sign of life. Idempotent."""


class Transport(ABC):
    """Carries keys and bytes between the containers of one system.

    Guarantees: messages on one key from one publisher arrive in order, and so do all announcements of one transport;
    a subscription made before an announcement receives everything that follows the announcement; once a sign of life
    has appeared, its transport can be queried; presence ends within the lease. The transport stores no announcements:
    a container that missed one queries for it. Channels, publishers and signs of life last while they are referenced.
    Once closed, every method but ``wake`` and ``close`` raises ChannelClosed.
    """

    clock: WaitClock = WaitClock()
    """The clock of long waits."""
    relayed: bool = False
    """Whether its one link is to a hub that relays everything."""
    beat_s: float = 2.0
    """The interval at which a container announces its revision, and so the longest time a loss stays unnoticed."""

    @abstractmethod
    def publish(self, key: str, *, urgent: bool = False, droppable: bool = False) -> Publisher:
        """Declare a key for publishing.

        Args:
            key: a literal key, not a pattern.
            urgent: messages overtake all others.
            droppable: ``put`` never waits; a stalled receiver loses what it cannot take at once. Messages that are
                droppable and not urgent are sent after all others.
        """

    @abstractmethod
    def subscribe(self, pattern: str, *, newest: int = 0) -> Channel:
        """Subscribe to keys that match a pattern.

        A publisher that is faster than the reader waits, and so does everything else on the same link.

        Args:
            pattern: the pattern of keys.
            newest: keep only this many unread messages and drop the oldest first; the publisher never waits.
        """

    @abstractmethod
    def announce(self, key: str, payload: bytes) -> None:
        """Publish once, without declaring the key; for a large number of keys. Waits like a put of a publisher."""

    @abstractmethod
    def announcements(self, pattern: str) -> Channel:
        """Subscribe to the announcements that others make from now on."""

    @abstractmethod
    def questions(self, pattern: str) -> Questions:
        """Receive the queries for keys that match."""

    @abstractmethod
    def ask(self, patterns: list[str], timeout_s: float) -> list[Answer]:
        """Query all other transports at once; returns their replies when all are done or the timeout has passed.

        A transport that is lost meanwhile is not waited for. Each pattern is a query of its own;
        what one transport replies to all of them is one answer.
        """

    @abstractmethod
    def appear(self, key: str) -> Presence:
        """Publish a sign of life."""

    @abstractmethod
    def presences(self, pattern: str) -> Channel:
        """Subscribe to all signs of life, current ones first; an empty payload appears, None disappears."""

    @abstractmethod
    def present(self, pattern: str, timeout_s: float) -> list[str]:
        """The current signs of life, own ones included."""

    def bridged(self) -> bool:
        """Whether the transport is or was just linked to a bridge: other containers may be visible only through it."""
        return False

    def bridge_lost(self) -> bool:
        """Whether a link to a bridge was just lost: containers behind it are out of sight and may come back."""
        return False

    def settle(self) -> None:
        """Declare that this container stays, if that makes a difference to the transport.

        During the change a message may arrive twice.
        """
        return

    @abstractmethod
    def wake(self, key: str, payload: bytes) -> None:
        """Publish to the readers of this transport only; nothing leaves the process."""

    @abstractmethod
    def close(self) -> None:
        """Close every channel and leave the network. Idempotent."""
