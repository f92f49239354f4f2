"""The suites' listeners: a channel read with a deadline, and meeting points."""

import contextlib
import itertools
import queue
import threading
from collections.abc import Mapping
from typing import Final

from trade.transport.base import Channel, ChannelClosed, Message, Transport

PATIENCE_S: Final = 10.0
"""How long a test waits for something that must come; far longer than it takes."""

_meetings = itertools.count()


class RecordingListener:
    """Reads a channel on its own threads, which end when the channel closes."""

    def __init__(self, channel: Channel, *, readers: int = 1) -> None:
        self.channel: Final = channel
        self._messages: queue.SimpleQueue[Message] = queue.SimpleQueue()
        self._threads = [threading.Thread(target=self._hear, name="ear", daemon=True) for _ in range(readers)]
        for thread in self._threads:
            thread.start()

    def _hear(self) -> None:
        while True:
            try:
                self._messages.put(self.channel.receive())
            except ChannelClosed:
                return

    def next(self) -> Message:
        """The next message.

        Raises:
            AssertionError: no message came.
        """
        try:
            return self._messages.get(timeout=PATIENCE_S)
        except queue.Empty:
            raise AssertionError(f"nothing was heard for {PATIENCE_S} s") from None

    def until(self, key: str, payload: bytes | None) -> list[Message]:
        """All messages before a certain one."""
        heard: list[Message] = []
        while (message := self.next()) != Message(key, payload):
            heard.append(message)
        return heard

    def ends(self) -> bool:
        """Whether the channel ended all its readers."""
        for thread in self._threads:
            thread.join(PATIENCE_S)
        return not any(thread.is_alive() for thread in self._threads)


class RegistryResponder:
    """Answers queries with announcements, on its own thread, which ends when the transport closes."""

    def __init__(self, transport: Transport, pattern: str, standing: Mapping[str, bytes]) -> None:
        self.questions: Final = transport.questions(pattern)
        self._standing = standing
        threading.Thread(target=self._tell, name="teller", daemon=True).start()

    def _tell(self) -> None:
        with contextlib.suppress(ChannelClosed):
            while True:
                question = self.questions.receive()
                with contextlib.suppress(ChannelClosed):
                    for key, payload in list(self._standing.items()):
                        question.answer(key, payload)
                question.close()


def listen(listener: Transport, pattern: str, *, speaker: Transport) -> RecordingListener:
    """Subscribe, and wait until the speaker knows of it."""
    ear = RecordingListener(listener.subscribe(pattern))
    meet(listener=listener, speaker=speaker)
    return ear


def meet(*, listener: Transport, speaker: Transport) -> None:
    """Wait until messages reach the listener's subscriptions: it sees a sign of life published after them."""
    point = f"meeting/{next(_meetings)}"
    ear = RecordingListener(speaker.presences(point))
    sign = listener.appear(point)
    assert ear.next().key == point  # noqa: S101
    sign.close()
    ear.channel.close()
    ear.ends()
