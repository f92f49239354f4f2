"""Threads that listen to the rest of the system: which containers exist, and what they offer."""

import logging
import math
import threading
import time
from collections.abc import Callable, Iterable
from typing import Final

from trade._discovery.grace_period import GracePeriods
from trade._discovery.resync import Resynchronizer
from trade._registry.registry import ContainerState, Registry
from trade._threads.scheduler import Scheduler
from trade.protocol.estop_messages import decode_open_estops
from trade.protocol.keys import ALIVE, BRIDGE, DOMAIN, REGISTRY, TALLY, Address, is_chunk, tally_key
from trade.protocol.messages import (
    PROTOCOL,
    Estop,
    Malformed,
    OtherVersion,
    ProviderInfo,
    decode_provider,
    decode_tally,
)
from trade.transport.base import Answer, Channel, ChannelClosed, Message, Transport

_logger = logging.getLogger("trade")

_SYNC_S: Final = 2.0
_STAYS_S: Final = 60.0
"""A container that has run for this long is not a short-lived one."""


class RegistryListener:
    """Feeds a registry from the network."""

    def __init__(
        self,
        transport: Transport,
        registry: Registry,
        own: Address,
        lost: Callable[..., None],
        ended: Callable[[str], None],
        returned: Callable[[str], None],
        beat: Callable[[], None],
        learn: Callable[[Iterable[Estop], Address], None],
        timers: Scheduler,
    ) -> None:
        self._registry = registry
        self._learn = learn
        self._own = own
        self._lost = lost
        self._ended = ended
        self._returned = returned
        self.malformed = 0
        self._beat = beat
        self._stays_from = time.monotonic() + _STAYS_S
        self._asker = Resynchronizer(transport, registry, self._answer, self._regularly, timers)
        self._transport = transport
        self._absences = GracePeriods(self._gone, transport.bridge_lost, timers)
        # Before the subscription: right after it, a session with one link finds none (zenoh 1.10).
        for key in transport.present(ALIVE, _SYNC_S):
            self._sign(Message(key, b""))
        entries, signs = transport.announcements(REGISTRY), transport.presences(ALIVE)
        self._channels = (entries, signs)
        self._threads = [
            threading.Thread(target=self._read, args=(entries, self._entry), name="trade-registry", daemon=True),
            threading.Thread(target=self._read, args=(signs, self._sign), name="trade-presence", daemon=True),
        ]
        for thread in (*self._threads, self._asker):
            thread.start()

    def sync(self) -> None:
        """Wait until the registry has what all offer that are there now; two seconds at most."""
        self._asker.wait(_SYNC_S)

    @property
    def busy(self) -> bool:
        """Whether a container is being queried for missed announcements."""
        return self._asker.busy

    def _regularly(self) -> None:
        self._beat()
        if time.monotonic() >= self._stays_from:
            self._stays_from = math.inf
            self._transport.settle()

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
            address, domain, provider = _place(message.key)
            if address == self._own:
                return
            payload = message.payload or b""
            if (domain, provider) == (DOMAIN, TALLY):
                complete = self._registry.count(address, decode_tally(payload).revision)
            else:
                complete = self._registry.put(address, domain, provider, decode_provider(payload))
            if not complete:
                self._asker.request(address)
        except OtherVersion as other:
            self._of_another_version(message, other)
        except Malformed as bad:
            self._drop(message.key, bad)

    def _of_another_version(self, message: Message, other: OtherVersion) -> None:
        """Takes from such a message only its version and the open e-stops."""
        self.malformed += 1
        address, domain, provider = _place(message.key)
        if self._registry.speaks(address, other.version):
            _logger.warning(
                "container %s/%s speaks protocol version %d, this one speaks %d: neither sees what the other offers, "
                "and only e-stops cross. Update the older one",
                *(address.identity, address.container, other.version, PROTOCOL),
            )
        if domain != DOMAIN or provider == TALLY:
            return
        try:
            estops = decode_open_estops(message.payload or b"")
        except Malformed as bad:
            self._drop(message.key, bad)
            return
        if self._registry.set_open_estops(address, domain, provider, estops):
            self._learn(estops, address)

    def _sign(self, message: Message) -> None:
        try:
            identity, container, epoch, *client = _chunks(message.key, 3, most=4)
        except Malformed as bad:
            self._drop(message.key, bad)
            return
        address = Address(identity, container, epoch)
        if address == self._own:
            return
        if client == [BRIDGE]:
            if message.payload is None:
                self._absences.bridge_left()
            return
        session = "/".join((str(address), *client))
        bridged = self._transport.bridged()
        if message.payload is None:
            if bridged:
                self._absences.begin(session)
            else:
                self._gone(session)
            return
        was_away = self._absences.end(session)
        self._returned(session)
        if not client:
            self._lost(address, back=True)
            if self._registry.appear(address) or (was_away and self._registry.reopen(address)):
                self._asker.request(address, appeared=True)

    def _gone(self, session: str) -> None:
        """A container, or a client of one, has ended or is unreachable."""
        identity, container, epoch, *client = session.split("/")
        if client:
            self._ended(session)
        else:
            address = Address(identity, container, epoch)
            self._lost(address)
            self._registry.vanish(address)

    def _answer(self, answer: Answer, meant: dict[Address, ContainerState]) -> None:
        """Take a container's reply with all that it offers. A reply that speaks for another container is ignored.

        The reply is emptied meanwhile: each of ten thousand entries is kept either encoded or decoded, never both.
        """
        offered: dict[str, tuple[str, ProviderInfo]] = {}
        speakers, revision, message = set[Address](), None, None
        others: list[tuple[Message, OtherVersion]] = []
        answer.messages.reverse()
        while answer.messages:
            message = answer.messages.pop()
            try:
                address, domain, provider = _place(message.key)
                speakers.add(address)
                if (domain, provider) == (DOMAIN, TALLY):
                    revision = decode_tally(message.payload or b"").revision
                else:
                    offered[provider] = (domain, decode_provider(message.payload or b""))
            except OtherVersion as other:
                others.append((message, other))
            except Malformed as bad:
                self._drop(message.key, bad)
        if message is not None and len(speakers) > 1:
            self._drop(message.key, Malformed("one container answered for several"))
            return
        for other_message, other in others:
            self._of_another_version(other_message, other)
        state = meant.get(speakers.pop()) if speakers else None
        if state is not None:
            state.transport = answer.who
        if state is not None and revision is not None:
            self._registry.settle(state, revision, offered)  # the tally comes last; without it the reply is incomplete
        elif state is not None and others and others[-1][0].key == tally_key(state.address):
            state.heard.replied(0)  # its entries have no tally: one query is enough

    def _drop(self, key: str, bad: Exception) -> None:
        self.malformed += 1
        if self.malformed == 1:
            _logger.warning("dropped a registry message on %s: %s (further ones are counted, not logged)", key, bad)

    def close(self) -> None:
        """End the threads. Idempotent."""
        self._asker.close()
        self._absences.close()
        for channel in self._channels:
            channel.close()
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(2)


def _place(key: str) -> tuple[Address, str, str]:
    """The container, the domain and the provider of an entry."""
    domain, identity, container, epoch, provider = _chunks(key, 5)
    return Address(identity, container, epoch), domain, provider


def _chunks(key: str, count: int, most: int = 0) -> list[str]:
    """The chunks of a key after its first. Raises Malformed for a pattern, on which a peer may publish, too."""
    chunks = key.split("/")[1:]
    if not count <= len(chunks) <= max(count, most) or not all(map(is_chunk, chunks)):
        raise Malformed(f"{key!r} is a pattern or of another shape")
    return chunks
