"""Agents over Streamable HTTP: clients of the HTTP gateway that speak the Model Context Protocol at ``/mcp``."""

import asyncio
import logging
import time
from collections.abc import AsyncGenerator, Sequence
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Final

import anyio
import msgspec
from anyio.abc import TaskGroup, TaskStatus
from anyio.streams.memory import MemoryObjectReceiveStream, MemoryObjectSendStream
from mcp.server.streamable_http import MCP_SESSION_ID_HEADER, StreamableHTTPServerTransport
from mcp.shared.message import ServerMessageMetadata, SessionMessage
from mcp.types import JSONRPCError, JSONRPCMessage, JSONRPCNotification, JSONRPCRequest, JSONRPCResponse
from msgspec import Struct
from starlette.requests import Request
from starlette.responses import Response
from starlette.types import Message, Receive, Scope, Send

from trade import Container
from trade.errors import TradeError
from trade_gateway.clients import Client, ClientApi, NoSuchSession
from trade_gateway.clients import _schemas as messages
from trade_gateway.clients._errors import BadMessage, HttpError
from trade_gateway.http._authentication import Authenticator
from trade_gateway.http._http import received, refusal
from trade_gateway.http._session_timeouts import Leases
from trade_gateway.language import read_lexicon
from trade_gateway.mcp import Approvals, Tools, Twin, converse

_logger = logging.getLogger("trade")

_IDLE_S: Final = 600.0
"""How long an agent without a lock may be silent, in seconds; one with a lock has the lease of a session."""
_LOOK_EVERY_S: Final = 0.5
_PINGS: Final = 4
"""Pings to a silent agent before its lease ends."""
_REFUSED: Final = 400


def _is_news(record: logging.LogRecord) -> bool:
    """Leaves out what the package logs as an error whenever a session ends: that its streams are closed."""
    error = record.exc_info[1] if record.exc_info else None
    return not isinstance(error, anyio.ClosedResourceError)


logging.getLogger("mcp.server.streamable_http").addFilter(_is_news)


class _Rpc(Struct):
    """What the gateway has to know of a message."""

    method: str = ""
    id: int | str | None = None


_RPC: Final = msgspec.json.Decoder(_Rpc)


class _Agent:
    """One agent: its session here, and the stream of messages to its tools."""

    def __init__(self, client: Client) -> None:
        self.client: Final = client
        self.transport: Final = StreamableHTTPServerTransport(client.secret)
        self.scope: Final = anyio.CancelScope()
        self.into, self.messages = anyio.create_memory_object_stream[SessionMessage | Exception](0)
        self.heard_at = self._pinged_at = time.monotonic()
        self._open: dict[int | str, None] = {}
        """Requests whose answer is awaited on their own connection."""

    async def relay(self, hears: MemoryObjectReceiveStream[SessionMessage | Exception]) -> None:
        """Passes messages to the tools. Answers to pings only prove that the agent is alive."""
        async with self.into:
            async for message in hears:
                if isinstance(message, Exception) or not isinstance(
                    message.message.root, JSONRPCResponse | JSONRPCError
                ):
                    await self.into.send(message)

    async def answer(self, request: _Rpc, scope: Scope, receive: Receive, send: Send) -> None:
        """Answers a request. If its connection ends before, the request ends, and with it the motion (S05)."""
        self.heard_at = time.monotonic()
        if request.id is None or not request.method:
            await self.transport.handle_request(scope, receive, send)
            return
        self._open[request.id] = None
        try:
            await self.transport.handle_request(scope, receive, send)
        finally:
            self._open.pop(request.id, None)
            with anyio.move_on_after(_LOOK_EVERY_S, shield=True):
                await self._cancel(request.id)

    async def _cancel(self, request: int | str) -> None:
        """Ends a request that is not answered yet."""
        params = {"requestId": request, "reason": "its connection has ended"}
        cancelled = JSONRPCNotification(jsonrpc="2.0", method="notifications/cancelled", params=params)
        with suppress(anyio.ClosedResourceError, anyio.BrokenResourceError):
            await self.into.send(SessionMessage(JSONRPCMessage(cancelled)))

    async def watch(self, says: MemoryObjectSendStream[SessionMessage]) -> None:
        """Returns when the agent has been silent for longer than its lease. Pings it before."""
        was_busy = False
        while True:
            await anyio.sleep(_LOOK_EVERY_S)
            now, busy = time.monotonic(), self.client.busy
            if busy and not was_busy:
                self.heard_at = now
            was_busy, lease_s = busy, messages.SESSION_LEASE_S if busy else _IDLE_S
            if now - self.heard_at > lease_s:
                return
            if now - max(self.heard_at, self._pinged_at) >= lease_s / _PINGS:
                self._pinged_at = now
                with anyio.move_on_after(_LOOK_EVERY_S):
                    await says.send(self._ping())

    def _ping(self) -> SessionMessage:
        """A ping on the connection of the newest request, else on the agent's stream of notifications."""
        ping = JSONRPCRequest(jsonrpc="2.0", id=f"ping-{self._pinged_at}", method="ping")
        newest = next(reversed(self._open), None)
        about = None if newest is None else ServerMessageMetadata(related_request_id=newest)
        return SessionMessage(JSONRPCMessage(ping), about)


class Agents:
    """The agents of an HTTP gateway, as an ASGI application. Each has its own session, whose end stops its motion.

    Args:
        container: the container of the HTTP gateway.
        api: the operations of clients.
        authenticator: identifies agents as it identifies other clients.
        leases: ends the sessions of agents that are no longer admitted.
        ask_first: groups in which every call with an effect needs approval, whatever the policy says.
        twin: the robot file to simulate for dry runs.
    """

    def __init__(
        self,
        container: Container,
        api: ClientApi,
        authenticator: Authenticator,
        leases: Leases,
        ask_first: Sequence[str] = (),
        twin: Path | None = None,
    ) -> None:
        self._container = container
        self._api = api
        self._authenticator = authenticator
        self._leases = leases
        self._approvals = Approvals(container, ask_first)
        self._lexicon = read_lexicon(None)
        self._twin = None if twin is None else Twin(twin)
        self._agents: dict[Client, _Agent] = {}
        self._tasks: TaskGroup | None = None

    @asynccontextmanager
    async def running(self) -> AsyncGenerator[None]:
        """Serves agents inside of this context. Their motion stops at its end."""
        try:
            async with anyio.create_task_group() as self._tasks:
                yield
                self._tasks.cancel_scope.cancel()
        finally:
            if self._twin is not None:
                with anyio.CancelScope(shield=True):
                    await self._api.in_thread(self._twin.close, stops=True)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answers one HTTP request."""
        request = Request(scope, receive)
        try:
            who = self._authenticator.who(scope)
            body = await received(request) if request.method == "POST" else b""
            asked = _read(body)
            name = request.headers.get(MCP_SESSION_ID_HEADER)
            agent = await self._begun(who, asked, scope) if name is None else self._named(name, who)
        except TradeError as error:
            self._api.note_refused(error)
            await refusal(error)(scope, receive, send)
            return
        if request.method == "DELETE":
            await self._api.in_thread(agent.client.close, stops=True)
            await Response()(scope, receive, send)
            return
        statuses: list[int] = []

        async def note(message: Message) -> None:
            if message["type"] == "http.response.start":
                statuses.append(message["status"])
            await send(message)

        try:
            await agent.answer(asked, scope, _replayed(body, receive), note)
        finally:
            if name is None and (not statuses or statuses[0] >= _REFUSED):
                agent.scope.cancel()

    def _named(self, name: str, identity: str) -> _Agent:
        """The agent that a request names. Raises NoSuchSession."""
        agent = self._agents.get(self._api.clients.of(name, identity))
        if agent is None:
            raise NoSuchSession(session=name[:8])
        return agent

    async def _begun(self, identity: str, request: _Rpc, scope: Scope) -> _Agent:
        """Opens a session for a new agent. Raises TooMany; HttpError: this request begins none."""
        if request.method != "initialize" or self._tasks is None:
            raise HttpError(status=400, problem="name a session (Mcp-Session-Id), or begin one with `initialize`")
        client = await self._api.in_thread(self._api.clients.open, identity)
        agent = self._agents[client] = _Agent(client)
        await self._tasks.start(self._converse, agent)
        self._leases.begin(client, 0, lambda: self._authenticator.still(scope, identity))
        return agent

    async def _converse(self, agent: _Agent, *, task_status: TaskStatus[None]) -> None:
        client, loop = agent.client, asyncio.get_running_loop()
        tools = Tools(self._container, self._api, client, self._approvals, self._lexicon, self._twin)

        def end() -> None:
            with suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(agent.scope.cancel)

        client.when_closed(end)
        try:
            with agent.scope:
                async with agent.transport.connect() as (hears, says), anyio.create_task_group() as tasks:
                    tasks.start_soon(agent.relay, hears)
                    tasks.start_soon(converse, self._api, client, tools, agent.messages, says)
                    task_status.started()
                    await agent.watch(says)
                    _logger.info("an agent of %s was silent for too long; its session ends", client.identity)
                    await self._api.in_thread(client.close, stops=True)
        except Exception:
            _logger.exception("the session of an agent of %s has failed", client.identity)
        finally:
            self._agents.pop(client, None)
            with anyio.CancelScope(shield=True):
                await self._api.in_thread(client.close, stops=True)
                await agent.transport.terminate()


def _read(body: bytes) -> _Rpc:
    try:
        return messages.read(body or b"{}", _RPC)
    except BadMessage as bad:
        raise HttpError(status=400, problem=f"this is no message of MCP: {bad.problem}") from None


def _replayed(body: bytes, receive: Receive) -> Receive:
    """A request's body once more, then what follows it."""
    first: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]

    async def replay() -> Message:
        return first.pop() if first else await receive()

    return replay
