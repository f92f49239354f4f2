"""The server of the Model Context Protocol, on standard input and output."""

import asyncio
import os
import signal
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager
from importlib.metadata import version
from typing import Any, Final

import anyio
import msgspec
from anyio.streams.memory import MemoryObjectReceiveStream, MemoryObjectSendStream
from mcp import types
from mcp.server.lowlevel import Server
from mcp.server.stdio import stdio_server
from mcp.shared.message import SessionMessage

from trade import Container
from trade_gateway.clients import Client, ClientApi
from trade_gateway.clients import _schemas as messages
from trade_gateway.language import Lexicon
from trade_gateway.mcp._approvals import Approvals
from trade_gateway.mcp._pictures import Pictures
from trade_gateway.mcp._simulation_twin import Twin
from trade_gateway.mcp._tools import TOOLS, Tools

Hears = MemoryObjectReceiveStream[SessionMessage | Exception]
Says = MemoryObjectSendStream[SessionMessage]

_INSTRUCTIONS: Final = """Robots as services. Look with `services` and `describe` first. Whatever moves something \
needs a lock over its group (`lock`), may need a person's approval, and can be tried with `dry_run`, which moves \
nothing. Release locks with `unlock`. Motion that you started stops when you disconnect. `stop` and `estop` need no \
lock."""
_KILLED_BY: Final = 128


async def serve(
    container: Container, approvals: Approvals, lexicon: Lexicon, twin: Twin | None, leave: Callable[[], None]
) -> None:
    """Serves the agent that has started this process, until it closes our standard input; then its motion stops.

    Args:
        container: the agent's container; its rights are the agent's.
        approvals: human approval of calls.
        lexicon: the known sentences.
        twin: for dry runs.
        leave: ends everything else of the process; called when a signal ends it.
    """
    api = ClientApi(container)
    client = await api.in_thread(api.clients.open, container.address.identity)
    tools = Tools(container, api, client, approvals, lexicon, twin)
    async with stdio_server() as (hears, says), _signals(client.close, leave):
        await converse(api, client, tools, hears, says)


async def converse(api: ClientApi, client: Client, tools: Tools, hears: Hears, says: Says) -> None:
    """Serves an agent over two streams. Its motion stops, and its session ends, at the end of what it hears."""
    server = _server_of(tools, Pictures(api, client, tools.record))
    passed_on, heard = anyio.create_memory_object_stream[SessionMessage | Exception](0)

    async def hear() -> None:
        """Ends with the agent's stream; the server itself would first wait for pending requests."""
        try:
            async with hears, passed_on:
                async for message in hears:
                    await passed_on.send(message)
        finally:
            with anyio.CancelScope(shield=True):
                await api.in_thread(client.close, stops=True)

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(hear)
        await server.run(heard, says, server.create_initialization_options())
        tasks.cancel_scope.cancel()


def _server_of(tools: Tools, pictures: Pictures) -> "Server[Any, Any]":
    server: Server[Any, Any] = Server("trade", version=version("trade-gateway"), instructions=_INSTRUCTIONS)

    async def listed() -> list[types.Tool]:
        return [
            types.Tool(
                name=name,
                description=tool.text,
                inputSchema=tool.schema,
                annotations=types.ToolAnnotations(readOnlyHint=tool.reads, destructiveHint=not tool.reads),
            )
            for name, tool in TOOLS.items()
        ]

    async def used(name: str, arguments: dict[str, Any]) -> list[types.ContentBlock]:
        async with _reporting(server) as progress:
            try:
                return _content(await tools.use(name, arguments, progress))
            except Exception as error:
                raise RuntimeError(f"{type(error).__name__}: {error}") from error

    server.list_tools()(listed)
    server.call_tool(validate_input=False)(used)
    server.list_resources()(pictures.listed)
    server.read_resource()(pictures.read)
    return server


@asynccontextmanager
async def _reporting(server: "Server[Any, Any]") -> AsyncGenerator[Callable[[Any], None]]:
    """Sends the latest progress of a call to the agent, if it has requested that."""
    context = server.request_context
    token = context.meta.progressToken if context.meta is not None else None
    if token is None:
        yield lambda _: None
        return
    loop, more = asyncio.get_running_loop(), asyncio.Event()
    newest: list[Any] = []

    def note(value: Any) -> None:
        newest[:] = [value]
        loop.call_soon_threadsafe(more.set)

    async def report() -> None:
        count = 0
        while True:
            await more.wait()
            more.clear()
            count += 1
            [content] = newest
            text = content if isinstance(content, str) else messages.encoder.encode(content).decode()
            await context.session.send_progress_notification(token, float(count), message=text)

    reporting = asyncio.ensure_future(report())  # not a task group: that would wrap the call's exceptions
    try:
        yield note
    finally:
        reporting.cancel()


def _content(result: Any) -> list[types.ContentBlock]:
    """A result as text, and a picture as a picture."""
    text = messages.encoder.encode(result).decode()
    match msgspec.json.decode(text):
        case {"result": {"format": ("jpeg" | "png") as kind, "data": str() as data, **rest}}:
            described = messages.encoder.encode({"format": kind, **rest}).decode()
            picture = types.ImageContent(type="image", data=data, mimeType=f"image/{kind}")
            return [types.TextContent(type="text", text=described), picture]
        case _:
            return [types.TextContent(type="text", text=text)]


@asynccontextmanager
async def _signals(stop: Callable[[], None], leave: Callable[[], None]) -> AsyncGenerator[None]:
    """On SIGTERM and SIGINT stops motion and ends the process, which would otherwise not end."""

    async def wait() -> None:
        with anyio.open_signal_receiver(signal.SIGTERM, signal.SIGINT) as signals:
            async for number in signals:
                await asyncio.get_running_loop().run_in_executor(None, stop)
                await asyncio.get_running_loop().run_in_executor(None, leave)
                os._exit(_KILLED_BY + number)

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(wait)
        yield
        tasks.cancel_scope.cancel()
