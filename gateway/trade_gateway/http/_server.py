"""The HTTP gateway's server: a listening socket, and the thread that serves it."""

import asyncio
import logging
import ssl
import threading
from collections.abc import AsyncGenerator, Collection, Sequence
from contextlib import asynccontextmanager, nullcontext
from pathlib import Path
from socket import AF_INET, AF_INET6, SO_REUSEADDR, SOL_SOCKET, socket
from typing import TYPE_CHECKING, Final, cast

import uvicorn
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.cors import CORSMiddleware
from starlette.routing import Route, WebSocketRoute

from trade import Container
from trade.errors import ConfigurationError
from trade.transport.bounded_listener import BoundedListener
from trade_gateway.clients import ClientApi
from trade_gateway.dashboard import pages
from trade_gateway.http._authentication import Authenticator, Tokens
from trade_gateway.http._http import SESSION, Http, broken, refused
from trade_gateway.http._origin_check import LOOPBACK_NAMES, Gate
from trade_gateway.http._protocols import HttpProtocol, SocketProtocol
from trade_gateway.http._session_timeouts import Leases
from trade_gateway.http._websocket import Socket
from trade_gateway.process._addresses import in_url, is_loopback

if TYPE_CHECKING:
    from trade_gateway.http._agents import Agents

_logger = logging.getLogger("trade")

AGENT_SESSION: Final = "Mcp-Session-Id"

MOST_CONNECTIONS: Final = 256
_MOST_DESCRIPTORS: Final = 2 * MOST_CONNECTIONS
"""Most connections, including those without a request or certificate yet."""
MOST_MESSAGE_BYTES: Final = 1 << 20
_PING_EVERY_S: Final = 0.5
_PONG_WITHIN_S: Final = 1.5
"""With the ping before it, this gives the 2 s after which a silent client is gone (S05)."""
_IDLE_S: Final = 10
_PARTING_S: Final = 2
_BACKLOG: Final = 128
_LAST_PORT: Final = 65_535
_JOINED_WITHIN_S: Final = 10.0


class HttpGateway:
    """The HTTP gateway of a container, for clients over HTTP and WebSocket. A context manager.

    Args:
        container: its system is made accessible; the caller closes it.
        listen: ``HOST:PORT``; port 0 selects a free one.
        tokens: the clients' identities.
        tls: folder with ``ca.pem``, ``cert.pem`` and ``key.pem``, as ``trade pki issue`` makes it.
        origins: other sites whose pages are allowed, such as ``http://localhost:5173``.
        hosts: further names of this host.
        mcp: whether agents are served at ``/mcp``; needs the extra ``mcp``.
        ask_first: groups in which every call of an agent with an effect needs approval, whatever the policy says.
        twin: the robot file to simulate for dry runs of agents.

    Raises:
        ConfigurationError: the address is in use or exposes it to a network by accident, or no client could connect.
    """

    def __init__(
        self,
        container: Container,
        *,
        listen: str = "127.0.0.1:7080",
        tokens: Tokens,
        tls: Path | None = None,
        origins: Sequence[str] = (),
        hosts: Sequence[str] = (),
        mcp: bool = False,
        ask_first: Sequence[str] = (),
        twin: Path | None = None,
    ) -> None:
        host, port = _address(listen)
        api = ClientApi(container)
        _check_reach(listen, host, api, tls)
        if not tokens and tls is None and not api.judge.lets_anybody_in:
            problem = "no client could connect. Create a token with `trade http token NAME`"
            raise ConfigurationError(where=f"HTTP gateway {listen}", problem=problem)
        self._api = api
        names = {*LOOPBACK_NAMES, *hosts} if is_loopback(host) else {in_url(host), *hosts}
        authenticator, leases = Authenticator(tokens, api.judge), Leases(api)
        agents = None
        if mcp:
            from trade_gateway.http._agents import Agents  # noqa: PLC0415 - the extra mcp may be missing

            agents = Agents(container, api, authenticator, leases, ask_first, twin)
        self._app = _application(api, authenticator, leases, agents, names, origins)
        context = None if tls is None else _context(tls)
        self._socket = BoundedListener(_bound(host, port), _MOST_DESCRIPTORS)
        self.url: Final = f"http{'s' if tls else ''}://{in_url(host)}:{self._socket.getsockname()[1]}"
        """Its address."""
        config = uvicorn.Config(
            self._app,
            loop="asyncio",
            http=HttpProtocol,
            ws=SocketProtocol,
            ws_max_size=MOST_MESSAGE_BYTES,
            ws_ping_interval=_PING_EVERY_S,
            ws_ping_timeout=_PONG_WITHIN_S,
            ws_per_message_deflate=False,
            lifespan="on",
            log_config=None,
            log_level="info",  # a lower level would log headers, and the tokens in them
            access_log=False,
            proxy_headers=False,
            server_header=False,
            limit_concurrency=MOST_CONNECTIONS,
            timeout_keep_alive=_IDLE_S,
            timeout_graceful_shutdown=_PARTING_S,
            ssl_context_factory=None if context is None else lambda _config, _default: context,
        )
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._serve, name="trade-http", daemon=True)

    def open(self) -> "HttpGateway":
        """Accepts clients; those that connect before it is ready wait."""
        self._thread.start()
        return self

    @property
    def serving(self) -> bool:
        """Whether it still serves."""
        return self._thread.is_alive()

    def close(self) -> None:
        """Accepts no more clients; motion of the connected ones stops. Idempotent."""
        self._api.clients.close()
        self._server.should_exit = True
        if self._thread.ident is not None:
            self._thread.join(_JOINED_WITHIN_S)
        self._socket.close()

    def _serve(self) -> None:
        try:
            asyncio.run(self._server.serve(sockets=[cast("socket", self._socket)]))
        except Exception:
            _logger.exception("the HTTP gateway at %s has ended", self.url)

    def __enter__(self) -> "HttpGateway":
        return self.open()

    def __exit__(self, *_: object) -> None:
        self.close()


def _application(
    api: ClientApi,
    authenticator: Authenticator,
    leases: Leases,
    agents: "Agents | None",
    hosts: Collection[str],
    origins: Sequence[str],
) -> Starlette:
    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncGenerator[None]:
        watching = asyncio.ensure_future(leases.keep_watch())
        try:
            async with nullcontext() if agents is None else agents.running():
                yield
        finally:
            watching.cancel()
            await api.in_thread(api.clients.close, stops=True)

    middleware = [Middleware(Gate, hosts=hosts, origins=origins)]
    if origins:
        cors = Middleware(
            CORSMiddleware,
            allow_origins=list(origins),
            allow_methods=["GET", "POST", "DELETE"],
            allow_headers=["Authorization", "Content-Type", SESSION, AGENT_SESSION, "Mcp-Protocol-Version"],
            expose_headers=[AGENT_SESSION],
        )
        middleware.append(cors)
    application = Starlette(
        routes=[
            *Http(api, authenticator, leases).routes(),
            WebSocketRoute("/ws", Socket(api, authenticator, leases).serve),
            *([] if agents is None else [Route("/mcp", agents)]),
            *pages(),
        ],
        middleware=middleware,
        exception_handlers={HTTPException: refused, 500: broken},
        lifespan=lifespan,
    )
    application.router.redirect_slashes = False
    return application


# --- the address


def _address(listen: str) -> tuple[str, int]:
    host, colon, port = listen.rpartition(":")
    if not colon or not host or not port.isdecimal() or int(port) > _LAST_PORT:
        raise ConfigurationError(where=f"listen {listen}", problem="write HOST:PORT, such as 127.0.0.1:7080")
    return host.strip("[]"), int(port)


def _check_reach(listen: str, host: str, api: ClientApi, tls: Path | None) -> None:
    """S21: raises ConfigurationError if it would be reachable from a network by accident."""
    if is_loopback(host):
        return
    if tls is None:
        problem = "is beyond this host, where others could read tokens. Use --tls FOLDER from `trade pki issue`"
        raise ConfigurationError(where=f"listen {listen}", problem=problem)
    if not api.judge.governed:
        problem = "is beyond this host, but there is no policy. Set TRADE_POLICY"
        raise ConfigurationError(where=f"listen {listen}", problem=problem)


def _bound(host: str, port: int) -> socket:
    made = socket(AF_INET6 if ":" in host else AF_INET)
    try:
        made.setsockopt(SOL_SOCKET, SO_REUSEADDR, 1)
        made.bind((host, port))
        made.listen(_BACKLOG)
    except OSError as bad:
        made.close()
        raise ConfigurationError(where=f"listen {host}:{port}", problem=f"cannot be used: {bad.strerror}") from None
    return made


def _context(folder: Path) -> ssl.SSLContext:
    """The TLS context: our certificate, and optional client certificates of the system's authority."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.verify_mode = ssl.CERT_OPTIONAL
    context.num_tickets = 0  # a ticket that arrives while another thread of a client writes can hang that client
    try:
        context.load_cert_chain(folder / "cert.pem", folder / "key.pem")
        context.load_verify_locations(folder / "ca.pem")
    except (OSError, ssl.SSLError) as bad:
        problem = f"has no matching ca.pem, cert.pem and key.pem ({bad.strerror or bad}). Run `trade pki issue NAME`"
        raise ConfigurationError(where=str(folder), problem=problem) from None
    return context
