"""The seam between the middleware and whatever carries its bytes.

Five verbs: publish, subscribe, announce (kept for late joiners), be present, close. Everything above is the same on any
implementation; ``_zenoh`` is the real one.
"""

from abc import ABC, abstractmethod

from msgspec import Struct


class ChannelClosed(Exception):
    """The channel, the publisher or the whole transport was closed; a reader's thread should end."""


class Message(Struct, frozen=True, gc=False):
    """Bytes and the key they were put on; no payload says that what stood there is gone."""

    key: str
    payload: bytes | None


def some(value: bytes) -> bytes:
    """The value of an announcement; raises ValueError for an empty one."""
    if not value:
        raise ValueError("an announcement has a value of at least one byte; close it to withdraw it")
    return value


class Channel(ABC):
    """A queue filled by the transport and read by our own threads; several may read one."""

    @abstractmethod
    def receive(self) -> Message:
        """Wait for the next message. Raises ChannelClosed once closed. Ctrl-C interrupts it."""

    @abstractmethod
    def close(self) -> None:
        """Wake and end every reader. Idempotent."""


class Publisher(ABC):
    """A key one may put on, declared once."""

    @abstractmethod
    def put(self, payload: bytes) -> None:
        """Send; may wait for a stalled receiver up to a second, never drops for one that is alive.

        Raises ChannelClosed once closed.
        """

    @abstractmethod
    def close(self) -> None:
        """Stop. For an announcement: everybody learns that it is gone. Idempotent."""


class Presence(ABC):
    """A sign of life that falls by itself when this process ends or cannot be reached."""

    @abstractmethod
    def close(self) -> None:
        """Take the sign down. Idempotent."""


class Transport(ABC):
    """What carries keys and bytes between the containers of one system.

    Guarantees: messages on one key from one publisher arrive in order; what is subscribed before something is announced
    hears all that follows the announcement; announcements reach those who come later; presence falls within the lease.
    Channels, publishers and signs of life last while they are kept. Once closed, every verb but ``wake`` and ``close``
    raises ChannelClosed.
    """

    @abstractmethod
    def publish(self, key: str, *, urgent: bool = False, droppable: bool = False) -> Publisher:
        """Declare a key to put on.

        Args:
            key: a literal one.
            urgent: what is put overtakes all others.
            droppable: ``put`` waits for nobody; what a stalled receiver cannot take at once it never gets.
        """

    @abstractmethod
    def subscribe(self, pattern: str) -> Channel:
        """Hear what is put on keys that match."""

    @abstractmethod
    def announce(self, key: str) -> Publisher:
        """Like publish, but the last value is kept for those who come later.

        A value is never empty: putting none raises ValueError.
        """

    @abstractmethod
    def announcements(self, pattern: str) -> Channel:
        """Hear announcements of others: those standing now, and all changes."""

    @abstractmethod
    def standing(self, pattern: str, timeout_s: float) -> list[Message]:
        """The announcements that stand now, one's own included, asked for and waited for."""

    @abstractmethod
    def appear(self, key: str) -> Presence:
        """Put up a sign of life."""

    @abstractmethod
    def presences(self, pattern: str) -> Channel:
        """Hear signs of life rise (empty payload) and fall (no payload), those standing now first; one's own, too."""

    @abstractmethod
    def present(self, pattern: str, timeout_s: float) -> list[str]:
        """The signs of life that stand now, one's own included."""

    @abstractmethod
    def wake(self, key: str, payload: bytes) -> None:
        """Put for the readers of this very transport only; nothing leaves the process."""

    @abstractmethod
    def close(self) -> None:
        """End every channel and leave. Idempotent."""
