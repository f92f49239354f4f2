"""Tools that are announced as read-only are called with all that could change something, and nothing is sent."""

from typing import Any, Final

from tests.unit.gateway.agents.agent_rig import Client, Robot, run
from tests.unit.gateway.test_ask_sentences import sentences
from trade import Container
from trade_gateway.clients._system_info import CallReader
from trade_gateway.language._catalogue import REQUESTS
from trade_gateway.mcp._tools import TOOLS

ORDERS: Final = [
    one["say"]
    for name in ("seen.toml", "unseen.toml")
    for one in sentences(name)
    if one["means"] and REQUESTS[one["means"]].is_order
]
ACTS: Final[list[dict[str, Any]]] = [
    {"group": "rosie.head", "name": name, **more}
    for name, more in (("turn", {"args": [0.5]}), ("spin", {}), ("stop", {}), ("state", {"args": {"angle_rad": 1}}))
]
UNWANTED: Final[dict[str, list[dict[str, Any]]]] = {
    "ask": [{"sentence": sentence} for sentence in ORDERS],
    "services": [*ACTS, {"group": "rosie", "name": "stop"}],
    "describe": ACTS,
    "locks": [{"group": "rosie.head"}, {"lock": "1234"}, {}],
    "dry_run": [*ACTS, {"group": "trade", "name": "estop", "args": ["now"]}],
}
"""For each tool, uses that would change something, if it could."""


class StillTwin:
    """A twin on which nothing happens."""

    def call(self, *_: Any) -> str:
        return "tried"


def test_no_tool_that_is_announced_as_read_only_changes_anything(robot: Robot, agent: Container) -> None:
    agent.set_tracing(True)
    log, reads = CallReader(agent, reads=False), CallReader(agent, reads=True)

    async def uses(client: Client) -> None:
        tools = (await client._session.list_tools()).tools
        announced = {tool.name for tool in tools if tool.annotations and tool.annotations.readOnlyHint}
        assert announced == set(UNWANTED)
        assert announced < set(TOOLS)
        for tool, uses in UNWANTED.items():
            for arguments in uses:
                answer = await client._session.call_tool(tool, arguments)
                assert answer.isError or tool != "ask", arguments

    log.read()
    run(uses, agent, twin=StillTwin())
    assert len(ORDERS) > 50
    assert [one.service for one in log.read()] == []
    assert "rosie.head.state" in [one.service for one in reads.read()]  # by the dry run: the log works
    assert (robot.head.angle, robot.head.goes.is_set(), robot.head.stopped.is_set()) == (0.0, False, False)
    assert (agent.locks(), agent.estops(), robot.container.estops()) == ([], [], [])
