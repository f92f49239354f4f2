"""The declared keys that a container puts its calls on: two for each provider it calls, as stops go before the rest."""

import threading

from trade._protocol.keys import Address, call_key
from trade._transport.base import Publisher, Transport


class CallPublishers:
    """Each is made once, and let go of with its provider."""

    def __init__(self, transport: Transport, identity: str) -> None:
        self._transport = transport
        self._identity = identity
        self._lock = threading.Lock()
        self._made: dict[str, Publisher] = {}
        """By key."""
        self._urgent: set[Publisher] = set()
        """Those of stops."""

    def get(self, callee: Address, domain: str, provider: str, *, stop: bool) -> Publisher:
        """The one of a provider. Raises ChannelClosed: everything is closed."""
        key = call_key(self._identity, callee, domain, provider, stop=stop)
        with self._lock:
            found = self._made.get(key)
            if found is None:
                found = self._made[key] = self._transport.publish(key, urgent=stop)
                if stop:
                    self._urgent.add(found)
            return found

    def of_stops(self, publisher: Publisher) -> bool:
        """Whether what is put there are stops."""
        return publisher in self._urgent

    def forget(self, callee: Address, domain: str, provider: str) -> None:
        """A provider is gone."""
        keys = [call_key(self._identity, callee, domain, provider, stop=stop) for stop in (False, True)]
        with self._lock:
            gone = [self._made.pop(key, None) for key in keys]
            self._urgent.difference_update(gone)
        for publisher in gone:
            if publisher is not None:
                publisher.close()

    def close(self) -> None:
        """Let go of all."""
        for publisher in list(self._made.values()):
            publisher.close()
