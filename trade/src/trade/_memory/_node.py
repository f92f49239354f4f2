"""One transport as its network sees it: what it announces, which signs it shows, what it hears."""

import queue
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from trade._memory._keys import meet
from trade._transport import Channel, ChannelClosed, Message


@dataclass(frozen=True, slots=True)
class Sample:
    """A message with its publisher and its place in that one's sequence."""

    message: Message
    publisher: int
    number: int


class MemoryChannel(Channel):
    """A queue of one node. Like zenoh's, it gives what came before it was closed, and ends then."""

    def __init__(self, pattern: str, forget: Callable[["MemoryChannel"], None], *, of_others: bool = False) -> None:
        self.pattern: Final = pattern
        self.of_others: Final = of_others
        """Whether it hears announcements: those of others, and none of them twice."""
        self._forget = forget
        self._queue: queue.SimpleQueue[Message | None] = queue.SimpleQueue()
        self._newest: dict[int, int] = {}
        self._given = self._taken = self._dealt_with = 0

    @property
    def busy(self) -> bool:
        """Whether its reader, if there is one only, still has something to take up or is at work on it."""
        return self._dealt_with < self._given

    def fits(self, key: str) -> bool:
        return meet(self.pattern, key)

    def take(self, message: Message) -> None:
        self._given += 1
        self._queue.put(message)

    def take_newer(self, sample: Sample) -> None:
        """Take it unless this one, or a later one of the same publisher, was there already."""
        if self._newest.get(sample.publisher, -1) < sample.number:
            self._newest[sample.publisher] = sample.number
            self.take(sample.message)

    def receive(self) -> Message:
        self._dealt_with = self._taken
        message = self._queue.get()
        if message is None:
            self._queue.put(None)  # for the next reader
            raise ChannelClosed
        self._taken += 1
        return message

    def close(self) -> None:
        self._forget(self)
        self._queue.put(None)


class Node:
    """One transport's place in the network, used under the network's lock."""

    def __init__(self, name: str) -> None:
        self.name: Final = name
        self.closed = False
        self.announced: dict[int, Sample] = {}
        """Publisher to its last value."""
        self.tokens: dict[int, str] = {}
        """Its own signs of life."""
        self.seen: dict[int, tuple[Node, str]] = {}
        """Signs of life that it knows to stand, its own included."""
        self.ears: list[MemoryChannel] = []
        self.watches: list[MemoryChannel] = []

    def __repr__(self) -> str:
        return f"<Node {self.name}>"

    def hears(self, key: str) -> bool:
        """Whether anybody here would read what is put on a key."""
        return any(ear.fits(key) for ear in self.ears)

    def take(self, sample: Sample, *, own: bool) -> None:
        """A message arrives."""
        for ear in self.ears:
            if not ear.fits(sample.message.key):
                continue
            if not ear.of_others:
                ear.take(sample.message)
            elif not own:
                ear.take_newer(sample)

    def take_history(self, sample: Sample) -> None:
        """The answer to a question for what stands arrives; only who hears announcements asked."""
        for ear in self.ears:
            if ear.of_others and ear.fits(sample.message.key):
                ear.take_newer(sample)

    def see(self, owner: "Node", token: int, key: str) -> None:
        """A sign of life rises."""
        if token not in self.seen:
            self.seen[token] = (owner, key)
            self._tell(key, b"")

    def lose_sight(self, token: int) -> None:
        """A sign of life falls."""
        _, key = self.seen.pop(token, (None, None))
        if key is not None:
            self._tell(key, None)

    def lose_all_of(self, owner: "Node") -> None:
        """Another node is gone or out of reach."""
        for token, (of, _) in list(self.seen.items()):
            if of is owner:
                self.lose_sight(token)

    def _tell(self, key: str, payload: bytes | None) -> None:
        for watch in self.watches:
            if watch.fits(key):
                watch.take(Message(key, payload))

    @property
    def busy(self) -> bool:
        """Whether somebody still has to take up an announcement or a sign of life."""
        return any(channel.busy for channel in [*self.watches, *(ear for ear in self.ears if ear.of_others)])

    def end(self) -> None:
        """Close every channel."""
        self.closed = True
        self.announced.clear()
        self.tokens.clear()
        self.seen.clear()
        for channel in [*self.ears, *self.watches]:
            channel.close()
