"""Agents over MCP: they see, and move nothing without a lock, a right and, where marked, a person's word."""

import json
import threading
from functools import partial
from pathlib import Path
from typing import Any

import anyio
import pytest
from anyio.to_thread import run_sync
from mcp import McpError

from tests.support.waiting import wait_until
from tests.unit.gateway.agents.agent_rig import Client, Robot, connected, run
from trade import Container, where
from trade._audit.events import Audit
from trade.testing import MemorySystem
from trade_gateway.mcp._tools import TOOLS


def test_an_agent_lists_the_services_that_exist(agent: Container) -> None:
    async def looks(client: Client) -> None:
        found = await client("services", group="rosie.head")
        assert {one["name"] for one in found} == {"state", "turn", "spin", "stop"}
        reported = await client("describe", group="rosie.head", name="turn")
        assert reported["arguments"]["properties"]["angle_rad"]["type"] == "number"
        assert (reported["needs_lock"], reported["needs_approval"]) == (True, False)
        assert await client("call", group="rosie.head", name="state") == {"result": {"position_rad": 0}}
        assert (await client("ask", sentence="Who has the head?"))[
            "text"
        ] == "Nobody has it: head is free."  # plain: Nobody

    run(looks, agent)


def test_tools_are_listed_with_self_contained_schemas(agent: Container) -> None:
    async def lists(client: Client) -> None:
        tools = (await client._session.list_tools()).tools
        assert [tool.name for tool in tools] == list(TOOLS)
        for tool in tools:
            assert tool.inputSchema["type"] == "object"
            assert "$ref" not in json.dumps(tool.inputSchema)
            assert tool.description
        assert {tool.name for tool in tools if tool.annotations and tool.annotations.readOnlyHint} == {
            *("services", "describe", "ask", "locks", "dry_run")
        }

    run(lists, agent)


def test_nothing_moves_without_a_lock_and_with_one_it_does(robot: Robot, agent: Container) -> None:
    async def moves(client: Client) -> None:
        call = {"group": "rosie.head", "name": "turn", "args": {"angle_rad": 0.5}}
        assert (await client.refused("call", **call)).startswith(
            "NeedsLock: rosie.head.turn uses head. Lock its group first"
        )
        other = await client("lock", group="rosie.legs", purpose="to walk")
        assert "NeedsLock" in await client.refused("call", **call)
        taken = await client("lock", group="rosie.head", purpose="to look")
        assert await client("call", **call) == {"result": 0.5}
        assert robot.head.angle == 0.5
        assert {one["purpose"] for one in (await client("locks"))["locks"]} == {"to look", "to walk"}
        assert await client("unlock", lock=taken["lock"]) == {"released": True}
        assert "NeedsLock" in await client.refused("call", **call)
        assert await client("unlock", lock=other["lock"]) == {"released": True}

    run(moves, agent)


def test_another_clients_lock_refuses_and_a_lost_lock_is_reported(
    memory: MemorySystem, robot: Robot, agent: Container
) -> None:
    person = memory.container("person", identity="ann")
    memory.settle()

    async def tries(client: Client) -> None:
        call = {"group": "rosie.head", "name": "turn", "args": [0.5]}
        await client("lock", group="rosie.head")
        await run_sync(lambda: person.break_lock(where(group="rosie.head"), "mine"))
        refusal = await client.refused("call", **call)
        assert "NeedsLock" in refusal or "LockLost" in refusal
        lost: list[str] = []
        with anyio.fail_after(20):
            while not lost:
                lost += (await client("locks"))["lost"]
        assert "mine" in lost[0]
        held = await run_sync(lambda: person.lock(where(group="rosie.head")).acquire())
        assert (await client.refused("lock", group="rosie.head", wait_s=0)).startswith("LockedByOther")
        await run_sync(held.release)
        assert robot.head.angle == 0.0

    run(tries, agent)


def test_what_an_agent_moves_stops_when_it_disconnects(robot: Robot, agent: Container) -> None:
    async def main() -> None:
        async with connected(agent) as client, anyio.create_task_group() as tasks:
            await client("lock", group="rosie.head")

            async def spins() -> None:
                await client("call", group="rosie.head", name="spin", deadline_s=60)

            tasks.start_soon(spins)
            await run_sync(robot.head.goes.wait, 20)
            tasks.cancel_scope.cancel()

    anyio.run(main)
    assert robot.head.stopped.wait(20)
    wait_until(lambda: agent.locks() == [])


class StuckTwin:
    """Nothing comes of what is tried on it until the test says so."""

    def __init__(self) -> None:
        self.tries = threading.Event()
        self.go_on = threading.Event()

    def call(self, *_: Any) -> None:
        self.tries.set()
        self.go_on.wait(60)


def test_S03_a_dry_run_that_does_not_end_keeps_nothing_of_an_agent_that_is_gone(robot: Robot, agent: Container) -> None:
    twin = StuckTwin()

    async def main() -> None:
        async with connected(agent, twin=twin) as client, anyio.create_task_group() as tasks:
            await client("lock", group="rosie.head")
            tasks.start_soon(partial(client, "dry_run", group="rosie.head", name="turn", args=[0.5]))
            await run_sync(twin.tries.wait, 20)
            tasks.cancel_scope.cancel()

    anyio.run(main)
    assert not twin.go_on.is_set()
    wait_until(lambda: agent.locks() == [])
    twin.go_on.set()


class AttentiveTwin:
    """Remembers where the robot is said to be."""

    def call(self, _handle: Any, _args: Any, _deadline_s: float, states: Any) -> str:
        self.states = states
        return "tried"


def test_a_dry_run_knows_where_each_part_of_the_robot_is(robot: Robot, agent: Container) -> None:
    twin, robot.legs.angle = AttentiveTwin(), 0.4

    async def tries(client: Client) -> None:
        assert await client("dry_run", group="rosie.head", name="turn", args=[0.5]) == "tried"
        assert twin.states == {"rosie.head": {"position_rad": 0.0}, "rosie.legs": {"position_rad": 0.4}}

    run(tries, agent, twin=twin)


def test_a_stop_needs_no_lock_and_ends_what_moves(robot: Robot, agent: Container) -> None:
    async def stops(client: Client) -> None:
        taken = await client("lock", group="rosie.head")
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(partial(client, "call", group="rosie.head", name="spin", deadline_s=60))
            await run_sync(robot.head.goes.wait, 20)
            assert await client("stop", group="rosie") == {"rosie.head.stop": "stopped", "rosie.legs.stop": "stopped"}
        await client("unlock", lock=taken["lock"])
        assert await client("stop", group="rosie.head") == {"rosie.head.stop": "stopped"}

    run(stops, agent)
    assert robot.head.stopped.is_set()


def test_a_call_that_the_agent_takes_back_is_ended(robot: Robot, agent: Container) -> None:
    async def takes_back(client: Client) -> None:
        await client("lock", group="rosie.head")

        async def spins() -> None:
            with pytest.raises(McpError, match="cancelled"):
                await client("call", group="rosie.head", name="spin", deadline_s=60)

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(spins)
            await run_sync(robot.head.goes.wait, 20)
            await client.take_back()
            assert await run_sync(robot.head.stopped.wait, 20)

    run(takes_back, agent)


def test_without_the_right_a_lock_is_not_enough(
    memory: MemorySystem, robot: Robot, governed: Path, agent: Container
) -> None:
    reader = memory.container("agent-of-readers", identity="reader")
    reader.load_policy(governed)
    memory.settle()

    async def tries(client: Client) -> None:
        assert {one["name"] for one in await client("services", group="rosie")} == {"state", "turn", "spin", "stop"}
        assert "AccessDenied" in await client.refused("lock", group="rosie.head")
        refusal = await client.refused("call", group="rosie.head", name="turn", args=[0.5])
        assert "NeedsLock" in refusal or "AccessDenied" in refusal
        assert await client("call", group="rosie.head", name="state") == {"result": {"position_rad": 0}}

    run(tries, reader)
    assert robot.head.angle == 0.0


def test_wrong_words_are_refused_and_say_what_is_right(agent: Container) -> None:
    async def errs(client: Client) -> None:
        assert "there is no tool 'fly'. Use one of services" in await client.refused("fly")
        assert "the arguments of call are wrong" in await client.refused("call", group="rosie.head")
        assert "unknown field" in await client.refused("services", colour="red")
        assert "NoSuchService" in await client.refused("call", group="rosie.head", name="sing")
        assert "NoTwin" in await client.refused("dry_run", group="rosie.head", name="turn", args=[0.1])
        assert "NotUnderstood" in await client.refused("ask", sentence="Colourless green ideas")
        assert "NoSuchService" in await client.refused("call", group="trade", name="estop")

    run(errs, agent)


def test_P58_the_dialogue_of_trade_ask_is_the_same_over_the_protocol(agent: Container, robot: Robot) -> None:
    host = agent.containers()[0].host
    dialogue = [
        ("Which computers are there?", f"There is one host: {host}."),
        ("Where is the turn service?", f"turn is in container robot on host {host}."),
        ("Who has the legs?", "Nobody has it: legs is free."),  # plain: Nobody
        ("Is everything all right?", "All is well."),
        ("What is new?", "I have not looked before; from now on I know."),
        ("what's new", "Nothing is new."),
    ]

    async def talks(client: Client) -> None:
        for asked, answered in dialogue:
            assert (await client("ask", sentence=asked))["text"] == answered
        await client("lock", group="rosie.legs", purpose="to walk")
        assert "for 'to walk'" in (await client("ask", sentence="Who has the legs?"))["text"]

    run(talks, agent)


def test_each_use_of_a_tool_is_on_the_record_also_a_refused_one(
    memory: MemorySystem, robot: Robot, tmp_path: Path
) -> None:
    reported: list[Any] = []
    agent = memory.container("agent", identity="agent")
    memory.settle()
    agent._parts.audit = Audit(reported.append, agent.address)

    async def uses(client: Client) -> None:
        await client("services", group="rosie.head")
        await client.refused("call", group="rosie.head", name="turn", args=[0.123])

    run(uses, agent)
    mine = [(one.what, one.about, one.outcome, one.who) for one in reported if one.what.startswith("agent's tool")]
    assert mine == [
        ("agent's tool services", "rosie.head", "ok", "agent"),
        ("agent's tool call", "rosie.head.turn", "NeedsLock", "agent"),
    ]
    assert "0.123" not in str(reported)


@pytest.mark.parametrize("sentence", ["stop", "Halt!", "E-stop because of smoke", "stop everything because I say so"])
def test_a_question_opens_no_e_stop_and_its_refusal_names_the_tools_that_do(
    robot: Robot, agent: Container, sentence: str
) -> None:
    async def asks(client: Client) -> None:
        refusal = await client.refused("ask", sentence=sentence)
        assert "`estop`" in refusal
        assert "`stop`" in refusal
        assert robot.container.estops() == []
        assert not robot.head.stopped.is_set()
        assert not robot.legs.stopped.is_set()
        await client("estop", reason="smoke")
        assert [one.reason for one in robot.container.estops()] == ["agent: smoke"]

    run(asks, agent)


def test_tools_announced_as_reading_have_no_effect_and_those_that_stop_are_announced_as_acting(
    agent: Container,
) -> None:
    async def lists(client: Client) -> None:
        tools = {tool.name: tool for tool in (await client._session.list_tools()).tools}
        for name in ("stop", "estop"):
            hints = tools[name].annotations
            assert hints is not None
            assert (hints.readOnlyHint, hints.destructiveHint) == (False, True)
        assert "`estop`" in (tools["ask"].description or "")

    run(lists, agent)
