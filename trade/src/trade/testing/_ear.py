"""Reading a channel with a deadline."""

import queue
import threading
from typing import Final

from trade._transport import Channel, ChannelClosed, Message

PATIENCE_S: Final = 10.0
"""How long a test waits for what must come; far above what it takes."""


class Ear:
    """Reads a channel on threads of its own, which end when the channel closes."""

    def __init__(self, channel: Channel, *, readers: int = 1) -> None:
        self.channel: Final = channel
        self._heard: queue.SimpleQueue[Message] = queue.SimpleQueue()
        self._threads = [threading.Thread(target=self._listen, name="ear", daemon=True) for _ in range(readers)]
        for thread in self._threads:
            thread.start()

    def _listen(self) -> None:
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
