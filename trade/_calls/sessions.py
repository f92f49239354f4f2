"""The sessions that a container opens for the clients for which it acts."""

import itertools
from collections.abc import Callable

from trade._calls.target import container_closed
from trade._context.sessions import Session
from trade.protocol.keys import Address, alive_key, as_chunk, client_name
from trade.transport.base import ChannelClosed, Transport


class Sessions:
    """Opens sessions of one container.

    Args:
        own: the container.
        transport: shows to others that a session lives.
        ended: called with the name of each session that is closed.
    """

    def __init__(self, own: Address, transport: Transport, ended: Callable[[str], None]) -> None:
        self._own = own
        self._transport = transport
        self._ended = ended
        self._numbers = itertools.count(1)

    def open_session(self, client: str, *, system: str = "") -> Session:
        """Opens a session for one client, such as a page or a connection, of a program that acts for many (S03).

        Inside ``with container.open_session("page"):`` calls and locks are the client's: when it is closed, the
        client's motion stops and its locks are lost, but those of no other client.

        Args:
            client: a name for it; others see ``identity/container/epoch/client.number``.
            system: the client's own system, if it is another one; others see ``system/client via identity``.

        Raises:
            ConfigurationError: the container is closed.
        """
        whose = f"{as_chunk(system)[:20]}:" if system else ""
        name = f"{self._own}/{whose}{client_name(client)}.{next(self._numbers)}"
        try:
            presence = self._transport.appear(alive_key(name))
        except ChannelClosed:  # closed by another thread meanwhile
            raise container_closed(self._own) from None
        return Session(self._own, name, presence, self._ended)
