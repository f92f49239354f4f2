"""A stand-in for a container on a network in memory: it sends what a container sends and forgets what it hears.

A thousand whole containers in one process would each keep a registry of all others, which no memory holds. What they
send to each other does not depend on that.
"""

import secrets
import threading
from collections.abc import Mapping

from msgspec import structs

from trade import Container
from trade._discovery.announcer import Announcer
from trade.protocol.keys import ALIVE, ESTOPS, REGISTRY, Address, calls_to, registry_key
from trade.protocol.messages import ProviderInfo, decode_provider
from trade.transport.base import ChannelClosed, Message
from trade.transport.memory import MemoryTransport, Network

Offer = Mapping[tuple[str, str], ProviderInfo]
"""Providers by domain and name."""
_ANSWER_S = 20.0


def offer_of(container: Container) -> Offer:
    """What a container answers to queries."""
    standing = dict(container._parts.announcer._current)
    return {(key.split("/")[1], key.split("/")[-1]): decode_provider(payload) for key, payload in standing.items()}


class StandIn:
    """One that is no container and costs the others what one would.

    Args:
        network: where it joins.
        name: of the container it stands for.
        offer: what it announces about itself.
        asks: whether it asks those there and those to come what they offer; else, so that very many begin quickly,
            none before `ask_from_now_on`.
    """

    def __init__(self, network: Network, name: str, offer: Offer, *, asks: bool = True) -> None:
        self.address = Address("bench", name, secrets.token_hex(6))
        self._transport = MemoryTransport(network, name)
        self._announcer = Announcer(self._transport, self.address)
        self._asks = asks
        for pattern in (ESTOPS, REGISTRY, *(calls_to(self.address, stop=stop) for stop in (False, True))):
            self._transport.subscribe(pattern, newest=1)
        for revision, ((domain, provider), info) in enumerate(offer.items(), 1):
            self._announcer.announce(domain, provider, structs.replace(info, revision=revision))
        self._known = set(self._transport.present(ALIVE, _ANSWER_S))
        self._signs = self._transport.presences(ALIVE)
        self._thread = threading.Thread(target=self._read, name="stand-in", daemon=True)
        self._presence = self._announcer.appear()
        if asks:
            self._transport.ask([REGISTRY], _ANSWER_S)
        self._thread.start()

    def ask_from_now_on(self) -> None:
        """Ask each container that joins."""
        self._asks = True

    def beat(self) -> None:
        """What a container does every two seconds."""
        self._announcer.beat(len(self._known))

    def _read(self) -> None:
        while True:
            try:
                self._take(self._signs.receive())
            except ChannelClosed:
                return

    def _take(self, sign: Message) -> None:
        _, identity, container, epoch = sign.key.split("/")
        address = Address(identity, container, epoch)
        new = sign.payload is not None and sign.key not in self._known and address != self.address
        self._known.add(sign.key)
        if new and self._asks:
            self._transport.ask([registry_key("*", address, "*")], _ANSWER_S)

    def close(self) -> None:
        """Leave."""
        self._transport.close()
        self._announcer.close()
