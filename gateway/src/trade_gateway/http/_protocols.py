"""What uvicorn leaves out: who has shown which certificate, and the end of connections whose other end is frozen."""

from asyncio import BaseTransport, TimerHandle
from typing import Any, Final

from starlette.types import ASGIApp, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from trade_gateway.http._authentication import CERTIFIED

_ASKED_WITHIN_S: Final = 10.0
"""How long a connection may stand without a whole request's head."""


class HttpProtocol(H11Protocol):
    """One connection over HTTP."""

    _waiting: TimerHandle | None = None
    _over = False
    """Whether it is gone, or a WebSocket's by now: its transport is then nothing to be asked of."""

    def connection_made(self, transport: Any) -> None:
        """Let the application know whose certificate was shown."""
        super().connection_made(transport)
        self.app = _telling(self.app, transport)
        self._wait()

    def data_received(self, data: bytes) -> None:
        """Those that never ask anything would take the place of others."""
        super().data_received(data)
        self._wait()

    def connection_lost(self, exc: Exception | None) -> None:
        """Who is gone is waited for no more."""
        self._wait_no_more()
        super().connection_lost(exc)

    def handle_websocket_upgrade(self, event: Any) -> None:
        """A WebSocket has asked what it came for."""
        self._wait_no_more()
        super().handle_websocket_upgrade(event)

    def _wait(self) -> None:
        if self._waiting is None and self._asks_nothing and not self._over:
            self._waiting = self.loop.call_later(_ASKED_WITHIN_S, self._waited)

    def _wait_no_more(self) -> None:
        self._over = True
        if self._waiting is not None:
            self._waiting.cancel()
            self._waiting = None

    def _waited(self) -> None:
        self._waiting = None
        if self._asks_nothing:
            self.transport.close()

    @property
    def _asks_nothing(self) -> bool:
        cycle: Any = self.cycle
        return cycle is None or cycle.response_complete


class SocketProtocol(WebSocketsSansIOProtocol):
    """One connection over a WebSocket."""

    def connection_made(self, transport: BaseTransport) -> None:
        """Likewise."""
        super().connection_made(transport)
        self.app = _telling(self.app, transport)

    def keepalive_timeout(self) -> None:
        """Who does not answer takes nothing more, either: what is still to be sent must not keep the session alive."""
        super().keepalive_timeout()
        self.transport.abort()


def _telling(app: Any, transport: BaseTransport) -> Any:
    certificate: Any = transport.get_extra_info("peercert")
    subject = certificate.get("subject", ()) if certificate else ()
    names = [text for part in subject for kind, text in part if kind == "commonName"]
    if len(names) != 1:
        return app
    inner: ASGIApp = app

    async def telling(scope: Scope, receive: Receive, send: Send) -> None:
        await inner({**scope, CERTIFIED: names[0]}, receive, send)

    return telling
