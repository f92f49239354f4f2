"""One transport as its network sees it: what it announces, which signs it shows, what it hears."""

import contextlib
import queue
from collections.abc import Callable
from typing import Final, Generic, TypeVar

from trade._transport.base import Channel, ChannelClosed, Message, Question, Questions
from trade._transport.memory.keys import meet

_T = TypeVar("_T")


class Inbox(Generic[_T]):
    """A queue of one node. Like zenoh's, it gives what came before it was closed, and ends then."""

    def __init__(self, pattern: str, forget: Callable[["Inbox[_T]"], None]) -> None:
        self.pattern: Final = pattern
        self._forget = forget
        self._queue: queue.SimpleQueue[_T | None] = queue.SimpleQueue()
        self._given = self._taken = self._dealt_with = 0

    @property
    def busy(self) -> bool:
        """Whether its reader, if there is one only, still has something to take up or is at work on it."""
        return self._dealt_with < self._given

    def fits(self, key: str) -> bool:
        return meet(self.pattern, key)

    def take(self, item: _T) -> None:
        self._given += 1
        self._queue.put(item)

    def receive(self) -> _T:
        self._dealt_with = self._taken
        item = self._queue.get()
        if item is None:
            self._queue.put(None)  # for the next reader
            raise ChannelClosed
        self._taken += 1
        return item

    def close(self) -> None:
        self._forget(self)
        self._queue.put(None)


class MemoryChannel(Inbox[Message], Channel):
    """What one subscription hears."""

    def __init__(
        self, pattern: str, forget: Callable[[Inbox[Message]], None], *, of_others: bool = False, newest: int = 0
    ) -> None:
        super().__init__(pattern, forget)
        self.of_others: Final = of_others
        """Whether it hears announcements, those of others."""
        self._newest = newest

    def take(self, item: Message) -> None:
        if self._newest and self._queue.qsize() >= self._newest:
            with contextlib.suppress(queue.Empty):  # its reader was quicker
                self._queue.get_nowait()
        super().take(item)


class MemoryQuestions(Inbox[Question], Questions):
    """What one is asked."""


class Node:
    """One transport's place in the network, used under the network's lock."""

    def __init__(self, name: str) -> None:
        self.name: Final = name
        self.closed = False
        self.tokens: dict[int, str] = {}
        """Its own signs of life."""
        self.seen: dict[int, tuple[Node, str]] = {}
        """Signs of life that it knows to stand, its own included."""
        self.ears: list[MemoryChannel] = []
        self.watches: list[MemoryChannel] = []
        self.asked: list[MemoryQuestions] = []

    def __repr__(self) -> str:
        return f"<Node {self.name}>"

    def hears(self, key: str) -> bool:
        """Whether anybody here would read what is put on a key."""
        return any(ear.fits(key) for ear in self.ears)

    def take(self, message: Message, *, own: bool) -> None:
        """A message arrives."""
        for ear in self.ears:
            if ear.fits(message.key) and not (own and ear.of_others):
                ear.take(message)

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
        """Whether somebody still has to take up an announcement, a sign of life or a question."""
        return any(inbox.busy for inbox in [*self.watches, *self.asked, *(ear for ear in self.ears if ear.of_others)])

    def end(self) -> None:
        """Close every channel."""
        self.closed = True
        self.tokens.clear()
        self.seen.clear()
        for inbox in [*self.ears, *self.watches, *self.asked]:
            inbox.close()
