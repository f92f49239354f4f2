"""What uvicorn leaves out: who has shown which certificate, and the end of connections whose other end is frozen."""

from asyncio import BaseTransport, TimerHandle
from typing import Any, Final

from starlette.types import ASGIApp, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from trade_gateway.door._entry import CERTIFIED

_ASKED_WITHIN_S: Final = 10.0
"""How long a connection may stand without a whole request's head."""


class HttpProtocol(H11Protocol):
    """One connection over HTTP."""

    _waiting: TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:
        """Let the application know whose certificate was shown."""
        super().connection_made(transport)
        self.app = _telling(self.app, transport)
        self._wait()

    def data_received(self, data: bytes) -> None:
        """Those that never ask anything would take the place of others."""
        super().data_received(data)
        self._wait()

    def _wait(self) -> None:
        if self._waiting is None and self._asks_nothing:
            self._waiting = self.loop.call_later(_ASKED_WITHIN_S, self._waited)

    def _waited(self) -> None:
        self._waiting = None
        if self._asks_nothing and self.transport.get_protocol() is self:
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
