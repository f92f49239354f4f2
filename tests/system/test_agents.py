"""An agent's client starts ``trade mcp`` as a program: what moves on the simulated robot is the judge."""

import json
import os
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import anyio
import psutil
import pytest
from anyio.to_thread import run_sync
from mcp import ClientSession, StdioServerParameters
from mcp.client.stdio import stdio_client

from tests.support.waiting import wait_until
from tests.system.conftest import ROOT, ROSIES_HEAD, Bench
from trade import service, where
from trade.testing import memory_system
from trade_gateway.mcp import Twin

FAR = [1.0, 0.0]


def _program(*words: str) -> StdioServerParameters:
    environment = {name: value for name, value in os.environ.items() if name.startswith("TRADE_") or name == "PATH"}
    return StdioServerParameters(command=sys.executable, args=["-m", "trade_gateway", "mcp", *words], env=environment)


async def _used(session: ClientSession, tool: str, **arguments: Any) -> Any:
    answer = await session.call_tool(tool, arguments)
    assert not answer.isError, answer.content
    [content] = answer.content
    assert content.type == "text"
    return json.loads(content.text)


def test_a_dry_run_on_the_twin_moves_nothing_and_predicts_what_the_robot_does(bench: Bench) -> None:

    async def main() -> None:
        async with (
            stdio_client(_program("--twin", str(ROSIES_HEAD))) as (hears, says),
            ClientSession(hears, says) as session,
        ):
            await session.initialize()
            call = {"group": "rosie.head", "name": "move_to", "args": [[0.4, -0.2]]}
            tried = await _used(session, "dry_run", **call)
            assert tried["ok"], tried
            assert tried["began_where_the_robot_is"]
            assert [abs(round(one["position_rad"], 1)) for one in tried["after"]] == [0.4, 0.2]
            beyond = await _used(session, "dry_run", **{**call, "args": [[9.0, 0.0]]})
            assert not beyond["ok"]
            assert beyond["error"].startswith("LimitExceeded")
            assert not bench.rests("neck.pan")
            taken = await _used(session, "lock", group="rosie.head", purpose="to look")
            done = await _used(session, "call", **call)
            assert [round(angle, 1) for angle in done["result"]] == [0.4, -0.2]
            await _used(session, "unlock", lock=taken["lock"])

    anyio.run(main)
    assert round(bench.rests("neck.pan")[-1], 1) == 0.4
    assert not [one for one in psutil.Process().children(recursive=True) if "--name twin" in " ".join(one.cmdline())]


def test_a_dry_run_begins_where_a_robot_is_whose_joints_are_not_at_zero(bench: Bench) -> None:
    there, goal = [0.6, -0.3], [0.5, -0.2]

    async def main() -> None:
        async with (
            stdio_client(_program("--twin", str(ROSIES_HEAD))) as (hears, says),
            ClientSession(hears, says) as session,
        ):
            await session.initialize()
            taken = await _used(session, "lock", group="rosie.head", purpose="to look")
            await _used(session, "call", group="rosie.head", name="move_to", args=[there])
            await _used(session, "unlock", lock=taken["lock"])
            tried = await _used(session, "dry_run", group="rosie.head", name="move_to", args=[goal])
            assert tried["ok"], tried
            assert tried["began_where_the_robot_is"]
            assert [round(one["position_rad"], 1) for one in tried["before"]] == there
            assert [round(one["position_rad"], 1) for one in tried["after"]] == goal
            joint = await _used(session, "dry_run", group="rosie.neck.pan", name="state")
            assert round(joint["before"]["position_rad"], 1) == there[0]

    anyio.run(main)
    assert round(bench.rests("neck.pan")[-1], 1) == there[0]


class Part:
    """A part of a robot that is where the test says."""

    @service(effect="read")
    def state(self) -> None: ...


PLACES = {
    "head": ("rosie.neck.pan", {"position_rad": 0.6}),
    "legs": ("rosie.legs", [{"position_rad": 0.05 * number} for number in (1, 2, 3, 4, 5, 6)]),
    "arm": ("ada.right", {"positions_rad": [0.4, -1.5, 1.0, -1.2, -1.5, 0.2]}),
    "hand": ("rosie.left.hand", {"width_m": 0.03}),
}


@pytest.mark.parametrize("part", PLACES)
def test_the_twin_is_brought_to_where_a_part_of_each_kind_is(system: str, part: str) -> None:
    group, there = PLACES[part]
    with memory_system() as memory, closing(Twin(ROOT / "examples" / f"{part}.toml")) as twin:
        robot = memory.container("robot")
        robot.register(Part(), group)
        tried = twin.call(robot.find(where(name="state", group=group)), [], 10.0, {group: there})
    assert tried.began_where_the_robot_is, tried
    for real, dry in zip(_several(there), _several(tried.before), strict=True):
        assert {name: dry[name] for name in real} == {
            name: pytest.approx(value, abs=0.02 if "rad" in name else 0.001) for name, value in real.items()
        }


def test_a_dry_run_begins_with_the_whole_robot_where_it_is_and_says_what_is_elsewhere(
    system: str, tmp_path: Path
) -> None:
    head, hand = ((ROOT / "examples" / f"{part}.toml").read_text() for part in ("head", "hand"))
    both = tmp_path / "both.toml"
    both.write_text(head + hand[hand.index("[bus.") :])
    states = {"rosie.neck.tilt": {"position_rad": -0.3}, "rosie.neck.pan": {"position_rad": 0.6}}
    with memory_system() as memory, closing(Twin(both)) as twin:
        robot = memory.container("robot")
        robot.register(Part(), "rosie.head")
        robot.register(Part(), "rosie.left.hand")
        state_of = {group: robot.find(where(name="state", group=group)) for group in ("rosie.head", "rosie.left.hand")}
        tried = twin.call(state_of["rosie.left.hand"], [], 10.0, states)
        assert (tried.began_where_the_robot_is, tried.elsewhere) == (True, ())
        unknown = twin.call(
            state_of["rosie.head"], [], 10.0, {"rosie.left.hand": None, "rosie.tail": [{"position_rad": 1}]}
        )
    assert [round(one["position_rad"], 1) for one in unknown.before] == [0.6, -0.3]
    assert (unknown.began_where_the_robot_is, unknown.elsewhere) == (False, ("rosie.tail", "rosie.left.hand"))


def _several(state: Any) -> list[dict[str, Any]]:
    return state if isinstance(state, list) else [state]


def test_S03_the_client_of_an_agent_dies_and_what_the_agent_moves_stops(bench: Bench) -> None:

    def has_moved() -> bool:
        return abs(bench.sim.control.device("neck.pan").position_rad) > 0.05

    async def main() -> None:
        async with stdio_client(_program()) as (hears, says), ClientSession(hears, says) as session:
            await session.initialize()
            await _used(session, "lock", group="rosie.head", purpose="to look")
            slowly = {"args": {"positions_rad": FAR, "speed_rad_s": 0.1}, "deadline_s": 60}
            async with anyio.create_task_group() as tasks:

                async def moves() -> None:
                    await session.call_tool("call", {"group": "rosie.head", "name": "move_to", **slowly})

                tasks.start_soon(moves)
                await run_sync(wait_until, has_moved, "the head has begun to move")
                tasks.cancel_scope.cancel()

    anyio.run(main)
    wait_until(lambda: bench.rests("neck.pan"), "the head rests")
    assert 0.0 < bench.rests("neck.pan")[-1] < FAR[0] / 2
