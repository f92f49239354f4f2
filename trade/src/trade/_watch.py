"""The threads that listen to the rest of the system: who is there, and what they offer."""

import logging
import threading
from collections.abc import Callable
from typing import Final

from trade._registry import Registry
from trade._system import PROVIDER
from trade._transport import Channel, ChannelClosed, Message, Transport
from trade._wire import ALIVE, REGISTRY, Address, Malformed, decode_provider, is_chunk, registry_key

_logger = logging.getLogger("trade")

_SYNC_S: Final = 2.0


class Watch:
    """Feeds a registry from the network. Construction ends with the first sync: what stands now is known then."""

    def __init__(self, transport: Transport, registry: Registry, own: Address, lost: Callable[..., None]) -> None:
        self._transport = transport
        self._registry = registry
        self._own = own
        self._lost = lost
        self.malformed = 0
        entries, signs = transport.announcements(REGISTRY), transport.presences(ALIVE)
        for key in transport.present(ALIVE, _SYNC_S):
            self._sign(Message(key, b""))
        for message in transport.standing(REGISTRY, _SYNC_S):
            self._entry(message)
        self._channels = (entries, signs)
        self._threads = [
            threading.Thread(target=self._read, args=(entries, self._entry), name="trade-registry", daemon=True),
            threading.Thread(target=self._read, args=(signs, self._sign), name="trade-presence", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def _read(self, channel: Channel, take: Callable[[Message], None]) -> None:
        while True:
            try:
                take(channel.receive())
            except ChannelClosed:
                return
            except Exception:
                _logger.exception("the registry could not take a message")

    def _entry(self, message: Message) -> None:
        try:
            domain, identity, container, epoch, provider = _chunks(message.key, 5)
            address = Address(identity, container, epoch)
            if address == self._own:
                return
            if message.payload is None:
                self._registry.remove(address, provider)
            else:
                self._registry.put(address, domain, provider, decode_provider(message.payload))
        except Malformed as bad:
            self._drop(message.key, bad)

    def _sign(self, message: Message) -> None:
        try:
            address = Address(*_chunks(message.key, 3))
        except Malformed as bad:
            self._drop(message.key, bad)
            return
        if address == self._own:
            return
        if message.payload is None:
            self._lost(address)
            self._registry.vanish(address)
        else:
            self._lost(address, back=True)
            self._catch_up(address)
            self._registry.appear(address)

    def _catch_up(self, address: Address) -> None:
        """Nobody tells what a container withdrew while it was out of sight; so ask what still stands."""
        known = self._registry.known_before(address)
        if not known:
            return
        standing = self._transport.standing(registry_key("*", address, "*"), _SYNC_S)
        offered = {message.key.rpartition("/")[2] for message in standing}
        if PROVIDER in offered:  # every container offers that; without it, nobody answered
            for provider in known - offered:
                self._registry.remove(address, provider, for_good=False)

    def _drop(self, key: str, bad: Exception) -> None:
        self.malformed += 1
        if self.malformed == 1:
            _logger.warning("dropped a registry message on %s: %s (further ones are counted, not logged)", key, bad)

    def close(self) -> None:
        """End the threads. Idempotent."""
        for channel in self._channels:
            channel.close()
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(2)


def _chunks(key: str, count: int) -> list[str]:
    """The chunks of a key after its first; one may put on a pattern, too, and that is nobody's key."""
    chunks = key.split("/")[1:]
    if len(chunks) != count or not all(map(is_chunk, chunks)):
        raise Malformed(f"{key!r} is a pattern or of another shape")
    return chunks
