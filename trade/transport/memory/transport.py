"""The transport interface on a network in memory."""

from collections.abc import Callable
from typing import Any

from trade.transport.base import Answer, Channel, ChannelClosed, Message, Presence, Publisher, Questions, Transport
from trade.transport.memory.keys import meet
from trade.transport.memory.links import MessageKind
from trade.transport.memory.network import Network
from trade.transport.memory.node import Inbox, MemoryChannel, MemoryQuestions


class MemoryPublisher(Publisher):
    """Publishes under one key of a network in memory."""

    def __init__(self, transport: "MemoryTransport", key: str, kind: MessageKind) -> None:
        self._transport = transport
        self._key = key
        self._kind = kind
        self._closed = False

    def put(self, payload: bytes) -> None:
        if self._closed:
            raise ChannelClosed
        self._transport.network.spread(self._transport.node, Message(self._key, payload), self._kind)

    def close(self) -> None:
        self._closed = True


class MemoryPresence(Presence):
    """A sign of life in a network in memory."""

    def __init__(self, transport: "MemoryTransport", key: str) -> None:
        self._transport = transport
        self._id = transport.network.next_number()
        transport.network.show(transport.node, self._id, key)

    def close(self) -> None:
        self._transport.network.hide(self._transport.node, self._id)


class MemoryTransport(Transport):
    """A transport on a network in memory.

    Args:
        network: the network to join.
        name: the name that taps see.
    """

    def __init__(self, network: Network, name: str = "") -> None:
        self.network = network
        self.beat_s = network.beat_s
        self.clock = network.waits
        self.node = network.join(name)

    @property
    def closed(self) -> bool:
        """Whether it was closed or killed."""
        return self.node.closed

    def publish(self, key: str, *, urgent: bool = False, droppable: bool = False) -> Publisher:
        self._check_open()
        return MemoryPublisher(
            self, key, MessageKind.DROPPABLE if droppable else MessageKind.URGENT if urgent else MessageKind.PUT
        )

    def subscribe(self, pattern: str, *, newest: int = 0) -> Channel:
        return self._listen(pattern, self.node.ears, newest=newest)

    def announce(self, key: str, payload: bytes) -> None:
        self.network.spread(self.node, Message(key, payload), MessageKind.ANNOUNCE)

    def announcements(self, pattern: str) -> Channel:
        return self._listen(pattern, self.node.ears, of_others=True)

    def questions(self, pattern: str) -> Questions:
        with self.network.lock:
            self._check_open()
            questions = MemoryQuestions(pattern, self._forget_in(self.node.asked))
            self.node.asked.append(questions)
            return questions

    def ask(self, patterns: list[str], timeout_s: float) -> list[Answer]:
        return self.network.ask(self.node, patterns, timeout_s)

    def appear(self, key: str) -> Presence:
        return MemoryPresence(self, key)

    def presences(self, pattern: str) -> Channel:
        with self.network.lock:
            channel = self._listen(pattern, self.node.watches)
            for key in self._present(pattern):
                channel.take(Message(key, b""))
            return channel

    def present(self, pattern: str, timeout_s: float) -> list[str]:  # noqa: ARG002 - nothing takes time
        self._check_open()
        with self.network.lock:
            return self._present(pattern)

    def _present(self, pattern: str) -> list[str]:
        return [key for _, key in self.node.seen.values() if meet(pattern, key)]

    def wake(self, key: str, payload: bytes) -> None:
        with self.network.lock:
            self.node.take(Message(key, payload), own=True)

    def close(self) -> None:
        self.network.leave(self.node)

    def _check_open(self) -> None:
        if self.closed:
            raise ChannelClosed

    def _listen(
        self, pattern: str, among: list[MemoryChannel], *, of_others: bool = False, newest: int = 0
    ) -> MemoryChannel:
        with self.network.lock:
            self._check_open()
            channel = MemoryChannel(pattern, self._forget_in(among), of_others=of_others, newest=newest)
            among.append(channel)
            self.network.clear_routes()
            return channel

    def _forget_in(self, among: list[Any]) -> Callable[[Inbox[Any]], None]:
        def forget(inbox: Inbox[Any]) -> None:
            with self.network.lock:
                if inbox in among:
                    among.remove(inbox)
                    self.network.clear_routes()

        return forget
