"""The five verbs on a network in memory."""

from trade._memory._keys import meet
from trade._memory._links import Kind
from trade._memory._network import Network
from trade._memory._node import MemoryChannel, Sample
from trade._transport import Channel, ChannelClosed, Message, Presence, Publisher, Transport, some


class MemoryPublisher(Publisher):
    def __init__(self, transport: "MemoryTransport", key: str, kind: Kind) -> None:
        self._transport = transport
        self._key = key
        self._kind = kind
        self._id = transport.network.next_number()
        self._count = 0
        self._closed = False

    def put(self, payload: bytes) -> None:
        self._spread(Message(self._key, payload), self._kind)

    def _spread(self, message: Message, kind: Kind) -> None:
        with self._transport.network.lock:
            if self._closed:
                raise ChannelClosed
            self._count += 1
            self._transport.network.spread(self._transport.node, Sample(message, self._id, self._count), kind)

    def close(self) -> None:
        self._closed = True


class MemoryAnnouncement(MemoryPublisher):
    def put(self, payload: bytes) -> None:
        super().put(some(payload))

    def close(self) -> None:
        with self._transport.network.lock:
            if not (self._closed or self._transport.closed):
                self._spread(Message(self._key, None), Kind.WITHDRAW)
            super().close()


class MemoryPresence(Presence):
    def __init__(self, transport: "MemoryTransport", key: str) -> None:
        self._transport = transport
        self._id = transport.network.next_number()
        transport.network.show(transport.node, self._id, key)

    def close(self) -> None:
        self._transport.network.hide(self._transport.node, self._id)


class MemoryTransport(Transport):
    """A transport on a network in memory.

    Args:
        network: the one it joins.
        name: what taps call it.
    """

    def __init__(self, network: Network, name: str = "") -> None:
        self.network = network
        self.node = network.join(name)

    @property
    def closed(self) -> bool:
        """Whether it was closed or killed."""
        return self.node.closed

    def publish(self, key: str, *, urgent: bool = False, droppable: bool = False) -> Publisher:
        self._check_open()
        return MemoryPublisher(self, key, Kind.DROPPABLE if droppable else Kind.URGENT if urgent else Kind.PUT)

    def subscribe(self, pattern: str) -> Channel:
        return self._listen(pattern, self.node.ears)

    def announce(self, key: str) -> Publisher:
        self._check_open()
        return MemoryAnnouncement(self, key, Kind.ANNOUNCE)

    def announcements(self, pattern: str) -> Channel:
        with self.network.lock:
            channel = self._listen(pattern, self.node.ears, of_others=True)
            self.network.ask_all(self.node, pattern)
            return channel

    def standing(self, pattern: str, timeout_s: float) -> list[Message]:  # noqa: ARG002 - nothing takes time
        return self.network.announced(self.node, pattern)

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
            self.node.take(Sample(Message(key, payload), 0, 0), own=True)

    def close(self) -> None:
        self.network.leave(self.node)

    def _check_open(self) -> None:
        if self.closed:
            raise ChannelClosed

    def _listen(self, pattern: str, among: list[MemoryChannel], *, of_others: bool = False) -> MemoryChannel:
        def forget(channel: MemoryChannel) -> None:
            with self.network.lock:
                if channel in among:
                    among.remove(channel)

        with self.network.lock:
            self._check_open()
            channel = MemoryChannel(pattern, forget, of_others=of_others)
            among.append(channel)
            return channel
