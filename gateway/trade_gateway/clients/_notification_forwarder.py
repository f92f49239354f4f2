"""Notifications of services, forwarded to a client that may know of them."""

from collections.abc import Callable

from trade import Handle
from trade_gateway.clients._authorizer import ClientAuthorizer
from trade_gateway.clients._clients import Client


class NotificationForwarder:
    """Forwards notifications of services to a client, if it may know of them."""

    def __init__(
        self, client: Client, occasion: str, judge: ClientAuthorizer, callback: Callable[[str, Handle], object]
    ) -> None:
        self._client = client
        self._occasion = occasion
        self._judge = judge
        self._tell = callback
        self.target_text = f"notify {client.identity} (a client of the HTTP gateway)"
        """Its text in lists of notifications."""

    def hear(self, handle: Handle) -> None:
        if self._judge.sees(self._client.identity, handle):
            self._tell(self._occasion, handle)
