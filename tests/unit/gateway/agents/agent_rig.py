"""A robot of two parts, and an agent that speaks to it over MCP."""

import json
import threading
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any

import anyio
import pytest
from anyio.to_thread import run_sync
from mcp import ClientSession
from mcp.shared.memory import create_client_server_memory_streams
from mcp.types import CancelledNotification, CancelledNotificationParams, ClientNotification

from tests.support.policies import policy_text
from trade import Container, Resource, service
from trade_gateway.clients import ClientApi
from trade_gateway.language import read_lexicon
from trade_gateway.mcp import Approvals, Tools, converse

POLICY = (
    policy_text(
        "agent=behaviour reader=viewer ann=operator bob=visitor robot=robot",
        behaviour="read=* call=rosie lock=rosie register=approvals",
        operator="read=* call=approvals administer=rosie.legs",
        robot="register=rosie",
        viewer="read=rosie",
        visitor="call=approvals read=approvals",
    )
    + '[approval]\n"agent*" = ["rosie.legs"]\n'
)


class Part:
    """Moves until it is stopped, or to an angle at once."""

    def __init__(self, name: str) -> None:
        self.resources = (Resource(name),)
        self.angle = 0.0
        self.stopped = threading.Event()
        self.goes = threading.Event()

    @service(effect="read")
    def state(self) -> dict[str, float]:
        """Where it is."""
        return {"position_rad": self.angle}

    @service
    def turn(self, angle_rad: float) -> float:
        """Turn there."""
        self.angle = angle_rad
        return angle_rad

    @service(cancel="stop")
    def spin(self) -> None:
        """Turn until stopped."""
        self.resources[0].moving = True
        self.goes.set()
        self.stopped.wait(60)

    @service(effect="stop")
    def stop(self) -> None:
        """Stop."""
        self.resources[0].moving = False
        self.stopped.set()


class Robot:
    def __init__(self, container: Container) -> None:
        self.container = container
        self.head, self.legs = Part("head"), Part("legs")
        container.register(self.head, "rosie.head")
        container.register(self.legs, "rosie.legs")


class Said(Exception):
    """The server refused."""


class Client:
    """The agent's side: what a tool answers, decoded; a refusal is an exception."""

    def __init__(self, session: ClientSession) -> None:
        self._session = session
        self.progress: list[str] = []

    async def __call__(self, tool: str, **arguments: Any) -> Any:
        async def note(_count: float, _total: float | None, message: str | None) -> None:
            self.progress.append(message or "")

        answer = await self._session.call_tool(tool, arguments, progress_callback=note)
        [content] = answer.content
        assert content.type == "text"
        if answer.isError:
            raise Said(content.text)
        return json.loads(content.text)

    async def take_back(self) -> None:
        """The call that was made last, as clients do when their user has enough of waiting."""
        params = CancelledNotificationParams(requestId=self._session._request_id - 1)
        await self._session.send_notification(ClientNotification(CancelledNotification(params=params)))

    async def refused(self, tool: str, **arguments: Any) -> str:
        with pytest.raises(Said) as said:
            await self(tool, **arguments)
        return str(said.value)


@asynccontextmanager
async def connected(
    container: Container, *, ask_first: tuple[str, ...] = (), twin: Any = None
) -> AsyncGenerator[Client]:
    async with create_client_server_memory_streams() as (ours, theirs), anyio.create_task_group() as tasks:
        api = ClientApi(container)
        agent = await run_sync(api.clients.open, container.address.identity)
        tools = Tools(container, api, agent, Approvals(container, ask_first), read_lexicon(), twin)
        tasks.start_soon(converse, api, agent, tools, *theirs)
        async with ClientSession(*ours) as session:
            await session.initialize()
            yield Client(session)
        await ours[1].aclose()


def run(scenario: Callable[..., Awaitable[None]], container: Container, **options: Any) -> None:
    async def main() -> None:
        with anyio.fail_after(60):
            async with connected(container, **options) as client:
                await scenario(client)

    anyio.run(main)
