"""The seam between the middleware and whatever carries its bytes.

Five verbs: publish, subscribe, announce (and answer who asks what stands), be present, close. Everything above is the
same on any implementation; ``zenoh`` is the real one.
"""

from abc import ABC, abstractmethod

from msgspec import Struct


class ChannelClosed(Exception):
    """The channel, the publisher or the whole transport was closed; a reader's thread should end."""


class Message(Struct, frozen=True, gc=False):
    """Bytes and the key they were put on; no payload says that what stood there is gone."""

    key: str
    payload: bytes | None


class Answer(Struct, frozen=True):
    """All that one who was asked has said."""

    who: str
    """Tells those apart that answer."""
    messages: list[Message]
    """In the order they were said."""


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
        """Stop. Idempotent."""


class Question(ABC):
    """Somebody asks what stands, and waits until it is closed."""

    @abstractmethod
    def answer(self, key: str, payload: bytes) -> None:
        """Say one thing that stands; what does not match what was asked is left out.

        May wait like a put. Raises ChannelClosed if nobody can hear it any more.
        """

    @abstractmethod
    def close(self) -> None:
        """That was all. Idempotent."""


class Questions(ABC):
    """A queue of questions, filled by the transport and read by our own threads."""

    @abstractmethod
    def receive(self) -> Question:
        """Wait for the next question. Raises ChannelClosed once closed."""

    @abstractmethod
    def close(self) -> None:
        """Wake and end every reader. Idempotent."""


class Presence(ABC):
    """A sign of life that falls by itself when this process ends or cannot be reached."""

    @abstractmethod
    def close(self) -> None:
        """Take the sign down. Idempotent."""


class Transport(ABC):
    """What carries keys and bytes between the containers of one system.

    Guarantees: messages on one key from one publisher arrive in order, and so do all announcements of one transport;
    what is subscribed before something is announced hears all that follows the announcement; once a sign of life has
    risen, its transport can be asked; presence falls within the lease. Nothing is kept of an announcement: who must
    have heard it asks. Channels, publishers and signs of life last while they are kept. Once closed, every verb but
    ``wake`` and ``close`` raises ChannelClosed.
    """

    beat_s: float = 2.0
    """How soon after an announcement who made it says how far it is: so long a lost one may go unnoticed."""

    @abstractmethod
    def publish(self, key: str, *, urgent: bool = False, droppable: bool = False) -> Publisher:
        """Declare a key to put on.

        Args:
            key: a literal one.
            urgent: what is put overtakes all others.
            droppable: ``put`` waits for nobody; what a stalled receiver cannot take at once it never gets. What is
                droppable and not urgent goes behind all others.
        """

    @abstractmethod
    def subscribe(self, pattern: str, *, newest: int = 0) -> Channel:
        """Hear what is put on keys that match.

        Whoever puts faster than it is read waits, and with it whatever else comes by the same link.

        Args:
            pattern: of keys.
            newest: nobody waits, and of what is not read in time only so many are kept; the oldest is lost first.
        """

    @abstractmethod
    def announce(self, key: str, payload: bytes) -> None:
        """Put once on one of very many keys: nothing is declared. Waits like a put of a publisher."""

    @abstractmethod
    def announcements(self, pattern: str) -> Channel:
        """Hear what others announce from now on."""

    @abstractmethod
    def questions(self, pattern: str) -> Questions:
        """Be asked what stands on keys that match."""

    @abstractmethod
    def ask(self, pattern: str, timeout_s: float) -> list[Answer]:
        """Ask all others at once what stands; what they have said when all are done, or when the time is over.

        Who is lost meanwhile is not waited for.
        """

    @abstractmethod
    def appear(self, key: str) -> Presence:
        """Put up a sign of life."""

    @abstractmethod
    def presences(self, pattern: str) -> Channel:
        """Hear signs of life rise (empty payload) and fall (no payload), those standing now first; one's own, too."""

    @abstractmethod
    def present(self, pattern: str, timeout_s: float) -> list[str]:
        """The signs of life that stand now, one's own included."""

    def bridged(self) -> bool:
        """Whether it is linked to a bridge, or was a moment ago: others may be seen through that only."""
        return False

    def bridge_lost(self) -> bool:
        """Whether a bridge to others went a moment ago: who is out of sight now may be behind it, and come back."""
        return False

    def settle(self) -> None:
        """Whoever has this is here to stay: say so, where it makes a difference to others.

        While it does, what is heard may come twice.
        """
        return

    @abstractmethod
    def wake(self, key: str, payload: bytes) -> None:
        """Put for the readers of this very transport only; nothing leaves the process."""

    @abstractmethod
    def close(self) -> None:
        """End every channel and leave. Idempotent."""
