"""Agents at an HTTP gateway: the client of the package ``mcp`` over a real socket, and requests written by hand."""

import json
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any

import anyio
import httpx
from mcp import ClientSession
from mcp.client.streamable_http import streamable_http_client
from mcp.types import LATEST_PROTOCOL_VERSION

from tests.support.http_clients import Client, Opened
from tests.support.waiting import PATIENCE_S
from trade_gateway.http import add_token

ACCEPTS = {"Accept": "application/json, text/event-stream"}
PEER = {"protocolVersion": LATEST_PROTOCOL_VERSION, "capabilities": {}, "clientInfo": {"name": "peer", "version": "1"}}


@asynccontextmanager
async def agent_of(
    served: Opened, who: str = "anna", *, leaves: bool = True, sent: list[str] | None = None
) -> AsyncGenerator[ClientSession]:
    """An agent with a token; with ``leaves=False`` it goes without a word.

    The methods of its requests are added to ``sent``.
    """
    requests = [] if sent is None else sent

    async def note(request: httpx.Request) -> None:
        requests.append(request.method)

    headers = {"Authorization": f"Bearer {add_token(served.tokens, who)}"}
    timeout = httpx.Timeout(PATIENCE_S)
    async with (
        httpx.AsyncClient(headers=headers, timeout=timeout, event_hooks={"request": [note]}) as connections,
        streamable_http_client(f"{served.gateway.url}/mcp", http_client=connections, terminate_on_close=leaves) as (
            hears,
            says,
            _,
        ),
        ClientSession(hears, says) as session,
    ):
        await session.initialize()
        yield session


async def used(session: ClientSession, tool: str, **arguments: Any) -> Any:
    """What a tool answers, decoded; for an error, its text."""
    answer = await session.call_tool(tool, arguments)
    [content] = answer.content
    assert content.type == "text"
    return content.text if answer.isError else json.loads(content.text)


def run(scenario: Callable[[], Awaitable[None]]) -> None:
    async def main() -> None:
        with anyio.fail_after(PATIENCE_S):
            await scenario()

    anyio.run(main)


def rpc(method: str, number: int = 1, **params: Any) -> dict[str, Any]:
    return {"jsonrpc": "2.0", "id": number, "method": method, "params": params}


def begun_by_hand(client: Client) -> Client:
    """The same client in a session of an agent that answers no pings."""
    answer = client.ask("POST", "/mcp", rpc("initialize", **PEER), **ACCEPTS)
    assert answer.status == 200, answer
    return Client(client.url, client.token, headers={**ACCEPTS, "Mcp-Session-Id": answer.headers["mcp-session-id"]})
