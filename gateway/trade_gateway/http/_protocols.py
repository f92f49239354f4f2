"""Additions to uvicorn's protocols: the client's certificate, and the end of connections whose client is frozen."""

from asyncio import BaseTransport, TimerHandle
from typing import Any, Final

from starlette.types import ASGIApp, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from trade_gateway.http._authentication import CERTIFIED

_REQUEST_WITHIN_S: Final = 10.0
"""How long a connection may exist without a complete request head, in seconds."""


class HttpProtocol(H11Protocol):
    """One HTTP connection."""

    _timeout: TimerHandle | None = None
    _over = False
    """Whether the connection is closed, or a WebSocket by now: then its transport must not be used."""

    def connection_made(self, transport: Any) -> None:
        """Stores the client's certificate for the application."""
        super().connection_made(transport)
        self.app = _with_certificate(self.app, transport)
        self._start_timeout()

    def data_received(self, data: bytes) -> None:
        """Restarts the timeout, as idle connections would take the place of others."""
        super().data_received(data)
        self._start_timeout()

    def connection_lost(self, exc: Exception | None) -> None:
        """Cancels the timeout."""
        self._cancel_timeout()
        super().connection_lost(exc)

    def handle_websocket_upgrade(self, event: Any) -> None:
        """Cancels the timeout: the request is complete."""
        self._cancel_timeout()
        super().handle_websocket_upgrade(event)

    def _start_timeout(self) -> None:
        if self._timeout is None and self._idle and not self._over:
            self._timeout = self.loop.call_later(_REQUEST_WITHIN_S, self._timed_out)

    def _cancel_timeout(self) -> None:
        self._over = True
        if self._timeout is not None:
            self._timeout.cancel()
            self._timeout = None

    def _timed_out(self) -> None:
        self._timeout = None
        if self._idle:
            self.transport.close()

    @property
    def _idle(self) -> bool:
        cycle: Any = self.cycle
        return cycle is None or cycle.response_complete


class SocketProtocol(WebSocketsSansIOProtocol):
    """One WebSocket connection."""

    def connection_made(self, transport: BaseTransport) -> None:
        """Gives the app the certificate of the connection."""
        super().connection_made(transport)
        self.app = _with_certificate(self.app, transport)

    def keepalive_timeout(self) -> None:
        """Aborts the connection: pending output of a frozen client must not keep its session alive."""
        super().keepalive_timeout()
        self.transport.abort()


def _with_certificate(app: Any, transport: BaseTransport) -> Any:
    certificate: Any = transport.get_extra_info("peercert")
    subject = certificate.get("subject", ()) if certificate else ()
    names = [text for part in subject for kind, text in part if kind == "commonName"]
    if len(names) != 1:
        return app
    inner: ASGIApp = app

    async def wrapped(scope: Scope, receive: Receive, send: Send) -> None:
        await inner({**scope, CERTIFIED: names[0]}, receive, send)

    return wrapped
