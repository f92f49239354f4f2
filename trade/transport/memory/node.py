"""One transport as its network sees it: its announcements, signs of life and subscriptions."""

import contextlib
import queue
from collections.abc import Callable
from typing import Final, Generic, TypeVar

from trade.transport.base import Channel, ChannelClosed, Message, Question, Questions
from trade.transport.memory.keys import meet

_T = TypeVar("_T")


class Inbox(Generic[_T]):
    """A queue of one node. Like zenoh's, it still delivers what came before it was closed."""

    def __init__(self, pattern: str, forget: Callable[["Inbox[_T]"], None]) -> None:
        self.pattern: Final = pattern
        self._forget = forget
        self._queue: queue.SimpleQueue[_T | None] = queue.SimpleQueue()
        self._given = self._taken = self._dealt_with = 0

    @property
    def busy(self) -> bool:
        """Whether its only reader still has an item to take or is working on one."""
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
    """The messages of one subscription."""

    def __init__(
        self, pattern: str, forget: Callable[[Inbox[Message]], None], *, of_others: bool = False, newest: int = 0
    ) -> None:
        super().__init__(pattern, forget)
        self.of_others: Final = of_others
        """Whether it receives announcements of other nodes."""
        self._newest = newest

    def take(self, item: Message) -> None:
        if self._newest and self._queue.qsize() >= self._newest:
            with contextlib.suppress(queue.Empty):  # its reader took it meanwhile
                self._queue.get_nowait()
        super().take(item)


class MemoryQuestions(Inbox[Question], Questions):
    """The queries that one node receives."""


class Node:
    """One transport's place in the network, used under the network's lock."""

    def __init__(self, name: str) -> None:
        self.name: Final = name
        self.closed = False
        self.tokens: dict[int, str] = {}
        """Its own signs of life."""
        self.seen: dict[int, tuple[Node, str]] = {}
        """The signs of life that it currently sees, its own included."""
        self.ears: list[MemoryChannel] = []
        self.watches: list[MemoryChannel] = []
        self.asked: list[MemoryQuestions] = []

    def __repr__(self) -> str:
        return f"<Node {self.name}>"

    def hears(self, key: str) -> bool:
        """Whether some reader of this node would receive a message on a key."""
        return any(ear.fits(key) for ear in self.ears)

    def take(self, message: Message, *, own: bool) -> None:
        """Receive a message."""
        for ear in self.ears:
            if ear.fits(message.key) and not (own and ear.of_others):
                ear.take(message)

    def see(self, owner: "Node", token: int, key: str) -> None:
        """A sign of life appears."""
        if token not in self.seen:
            self.seen[token] = (owner, key)
            self._report(key, b"")

    def lose_sight(self, token: int) -> None:
        """A sign of life disappears."""
        _, key = self.seen.pop(token, (None, None))
        if key is not None:
            self._report(key, None)

    def lose_all_of(self, owner: "Node") -> None:
        """Another node is gone or unreachable."""
        for token, (of, _) in list(self.seen.items()):
            if of is owner:
                self.lose_sight(token)

    def _report(self, key: str, payload: bytes | None) -> None:
        for watch in self.watches:
            if watch.fits(key):
                watch.take(Message(key, payload))

    @property
    def busy(self) -> bool:
        """Whether an announcement, a sign of life or a query still waits for its reader."""
        return any(inbox.busy for inbox in [*self.watches, *self.asked, *(ear for ear in self.ears if ear.of_others)])

    def end(self) -> None:
        """Close every channel."""
        self.closed = True
        self.tokens.clear()
        self.seen.clear()
        for inbox in [*self.ears, *self.watches, *self.asked]:
            inbox.close()
