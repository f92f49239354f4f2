"""What the suites listen with: a channel read with a deadline, and meeting points."""

import itertools
import queue
import threading
from typing import Final

from trade._transport import Channel, ChannelClosed, Message, Publisher, Transport

PATIENCE_S: Final = 10.0
"""How long a test waits for what must come; far above what it takes."""

_meetings = itertools.count()


class Ear:
    """Reads a channel on threads of its own, which end when the channel closes."""

    def __init__(self, channel: Channel, *, readers: int = 1) -> None:
        self.channel: Final = channel
        self._heard: queue.SimpleQueue[Message] = queue.SimpleQueue()
        self._threads = [threading.Thread(target=self._hear, name="ear", daemon=True) for _ in range(readers)]
        for thread in self._threads:
            thread.start()

    def _hear(self) -> None:
        while True:
            try:
                self._heard.put(self.channel.receive())
            except ChannelClosed:
                return

    def next(self) -> Message:
        """The next message.

        Raises:
            AssertionError: none came.
        """
        try:
            return self._heard.get(timeout=PATIENCE_S)
        except queue.Empty:
            raise AssertionError(f"nothing was heard for {PATIENCE_S} s") from None

    def until(self, key: str, payload: bytes | None) -> list[Message]:
        """Everything up to and without a certain message."""
        heard: list[Message] = []
        while (message := self.next()) != Message(key, payload):
            heard.append(message)
        return heard

    def ends(self) -> bool:
        """Whether the channel ended all its readers."""
        for thread in self._threads:
            thread.join(PATIENCE_S)
        return not any(thread.is_alive() for thread in self._threads)


def announce(transport: Transport, key: str, payload: bytes) -> Publisher:
    """An announcement with a value; it stands while it is kept."""
    announcement = transport.announce(key)
    announcement.put(payload)
    return announcement


def listen(listener: Transport, pattern: str, *, speaker: Transport) -> Ear:
    """Subscribe, and wait until the speaker knows."""
    ear = Ear(listener.subscribe(pattern))
    meet(listener=listener, speaker=speaker)
    return ear


def meet(*, listener: Transport, speaker: Transport) -> None:
    """What the listener has subscribed, the speaker reaches from now on: it hears an announcement made after it."""
    point = f"meeting/{next(_meetings)}"
    ear = Ear(speaker.announcements(point))
    announcement = announce(listener, point, b"here")
    ear.until(point, b"here")
    announcement.close()
    ear.channel.close()
    ear.ends()
