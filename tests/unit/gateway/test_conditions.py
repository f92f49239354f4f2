"""The pre-conditions and post-conditions of services, wherever services are shown: a terminal, HTTP, agents, stubs."""

import json
from pathlib import Path
from typing import Any

import anyio
import pytest
from typer.testing import CliRunner

from tests.conftest import StartContainer
from tests.support.http_clients import served_axis
from tests.unit.gateway.agents.agent_rig import Client, connected
from trade import pddl_domain, service, where
from trade.testing import memory_system
from trade_gateway.cli import build
from trade_gateway.stubs import write_stubs

pytestmark = pytest.mark.virtual_time

NEEDS, ACHIEVES = ["see(?thing)", "at(?place)"], ["holding(?thing)"]
SAID = "needs see(?thing), at(?place); achieves holding(?thing)"


class Hand:
    @service(needs=NEEDS, achieves=ACHIEVES)
    def pick_up(self, thing: str) -> None:
        """Close around it."""

    @service(effect="read", achieves="see(?thing)")
    def look(self) -> bool:
        return True

    @service(effect="stop")
    def stop(self) -> None: ...


def conditions(shown: dict[str, Any]) -> tuple[list[str], list[str]]:
    return shown["needs"], shown["achieves"]


def test_the_http_gateway_lists_and_documents_conditions(tmp_path: Path) -> None:
    with served_axis(tmp_path) as served:
        served.robot.system.container("hands").register(Hand(), "robot.hand")
        served.robot.system.settle()
        anna = served.client()
        listed = {one["name"]: conditions(one) for one in anna.ask("GET", "/services?group=robot.hand").body}
        assert listed == {"pick_up": (NEEDS, ACHIEVES), "look": ([], ["see(?thing)"]), "stop": ([], [])}
        for asked, names in (
            ("achieves=see(mug)", ["look"]),
            ("needs=at(dock)", ["pick_up"]),
            ("needs=see(?x)&achieves=see(?x)", []),
        ):
            assert [one["name"] for one in anna.ask("GET", f"/services?{asked}").body] == names, asked
        assert anna.ask("GET", "/services?needs=see(").body == []
        operation = anna.ask("GET", "/openapi.json").body["paths"]["/call/robot.hand/pick_up"]["post"]
        assert (operation["x-trade-needs"], operation["x-trade-achieves"]) == (NEEDS, ACHIEVES)


def test_an_agent_sees_conditions() -> None:
    async def look(client: Client) -> None:
        listed = {one["name"]: conditions(one) for one in await client("services", group="rosie")}
        assert listed["pick_up"] == (NEEDS, ACHIEVES)
        assert [one["name"] for one in await client("services", achieves="see(mug)")] == ["look"]
        assert conditions((await client("describe", group="rosie", name="pick_up"))["service"]) == (NEEDS, ACHIEVES)

    async def connect() -> None:
        async with connected(agent) as client:
            await look(client)

    with memory_system() as system:
        system.container("hands").register(Hand(), "rosie")
        agent = system.container("agent")
        system.settle()
        anyio.run(connect)


def test_stubs_say_conditions_where_an_editor_shows_them() -> None:
    with memory_system() as system:
        handles = system.container("hands").register(Hand(), "rosie")
        text = write_stubs(handles, "rosie", "lab")
    assert f"        Close around it.\n\n        {SAID}\n" in text


def listed(*words: str) -> set[str]:
    shown = CliRunner().invoke(build(), ["services", *words, "--json"], catch_exceptions=False)
    return {one["name"] for one in json.loads(shown.output)}


def test_the_command_line_shows_and_searches_conditions(start_container: StartContainer) -> None:
    start_container("hands").register(Hand(), "rosie")
    shown = CliRunner().invoke(build(), ["services", "--json"], catch_exceptions=False)
    by_name = {one["name"]: conditions(one) for one in json.loads(shown.output)}
    assert by_name == {"pick_up": (NEEDS, ACHIEVES), "look": ([], ["see(?thing)"]), "stop": ([], [])}
    documented = CliRunner().invoke(build(), ["services", "--doc"], catch_exceptions=False)
    assert f"  Close around it.\n\n  {SAID}\n" in documented.output
    assert listed("--needs", "see(mug)") == {"pick_up"}
    assert listed("--achieves", "see(?x)") == {"look"}
    assert listed("--achieves", "holding(?x)", "--needs", "at(dock)") == {"pick_up"}


def test_the_command_line_prints_a_planning_domain(start_container: StartContainer) -> None:
    class Crane:
        @service(achieves="at(pose(?x), high)")
        def lift(self) -> None: ...

    hands = start_container("hands")
    hands.register(Hand(), "rosie.hand")
    printed = CliRunner().invoke(build(), ["services", "--group", "rosie.hand", "--pddl"], catch_exceptions=False)
    assert printed.output == pddl_domain(hands.services("rosie.hand"), "rosie.hand")
    assert "(:action rosie-hand-pick_up" in printed.output
    hands.register(Crane(), "rosie.crane")
    warned = CliRunner().invoke(build(), ["services", "--pddl"], catch_exceptions=False)
    assert warned.stdout == pddl_domain(hands.services(~where(group="trade")))
    assert "left out rosie.crane.lift: at(pose(?x), high): PDDL has no term" in warned.stderr


@pytest.mark.parametrize("option", ["--needs", "--achieves"])
def test_a_malformed_predicate_is_a_usage_error(system: str, option: str) -> None:
    refused = CliRunner().invoke(build(), ["services", option, "see("])
    assert f"{option} see(" in str(refused.exception)
    assert "write it like see(?x)" in str(refused.exception)
