"""Checks the Host and Origin of every request first: the name in use, and the site of the calling page."""

from collections.abc import Collection
from typing import Final

from starlette.datastructures import Headers
from starlette.responses import Response
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket

from trade_gateway.clients._errors import WrongOrigin
from trade_gateway.clients._problems import problem_of
from trade_gateway.clients._schemas import encoder

MEDIA_TYPE: Final = "application/problem+json"
"""Media type of errors, by RFC 9457."""
LOOPBACK_NAMES: Final = frozenset({"127.0.0.1", "localhost", "[::1]"})


class Gate:
    """Refuses requests that a page made without its user's knowledge.

    A page of the gateway itself has as ``Origin`` what ``Host`` says; another site's origin is not listed.
    A site that points its own name to this host (DNS rebinding) has that name in ``Host``.
    """

    def __init__(self, app: ASGIApp, *, hosts: Collection[str], origins: Collection[str]) -> None:
        self._app = app
        self._hosts = frozenset(host.lower() for host in hosts)
        self._origins = frozenset(origins)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        wrong = self._wrong(scope, Headers(scope=scope))
        if wrong is None:
            await self._app(scope, receive, send)
        elif scope["type"] == "http":
            await problem_response(wrong)(scope, receive, send)
        else:
            await WebSocket(scope, receive, send).send_denial_response(problem_response(wrong))

    def _wrong(self, scope: Scope, headers: Headers) -> WrongOrigin | None:
        host = _without_port(headers.get("host", "")).lower()
        if host not in self._hosts:
            remedy = f"use {', '.join(sorted(self._hosts))}, or allow this name with `trade http --host NAME`"
            return WrongOrigin(what=f"host {host!r}", remedy=remedy)
        origin = headers.get("origin")
        if origin is not None and origin not in self._origins and origin != _own_site(scope, headers):
            return WrongOrigin(what=f"a page of {origin!r}", remedy="`trade http --origin URL` allows it")
        return None


def problem_response(error: BaseException, headers: dict[str, str] | None = None) -> Response:
    """Returns an error as a response."""
    problem = problem_of(error)
    return Response(encoder.encode(problem), problem.status, headers, MEDIA_TYPE)


def _own_site(scope: Scope, headers: Headers) -> str:
    """The origin of the gateway's own pages, under the name in the request."""
    return f"{'https' if scope['scheme'] in ('https', 'wss') else 'http'}://{headers.get('host', '').lower()}"


def _without_port(host: str) -> str:
    return host if host.endswith("]") else host.rpartition(":")[0] if ":" in host else host
