"""What is marked in the policy waits for a person's word, and only for one who may say it."""

from pathlib import Path
from typing import Any

import anyio
import pytest
from anyio.to_thread import run_sync

from tests.support.waiting import wait_until
from tests.unit.gateway.agents.agent_rig import POLICY, Client, Part, Robot, run
from trade import Container, service, where
from trade.errors import AccessDenied, ConfigurationError, TradeError
from trade.testing import MemorySystem
from trade_gateway.mcp import Approvals


def _decide(by: Container, word: str, *more: str) -> None:
    """As soon as something waits, say that word of it."""
    found: list[Any] = []

    def waits() -> bool:
        handles = by.services(where(name="pending", group="approvals"))
        found[:] = [(one, handle) for handle in handles for one in handle()]
        return bool(found)

    wait_until(waits)
    [(one, handle)] = found
    by.find(where(name=word, container=handle.container), wait_s=5)(one.id, *more)


def test_a_marked_call_waits_for_the_approval_of_a_person(
    memory: MemorySystem, robot: Robot, governed: Path, agent: Container
) -> None:
    person = memory.container("person", identity="ann")
    person.load_policy(governed)
    memory.settle()
    call = {"group": "rosie.legs", "name": "turn", "args": [0.5], "why": "to go there"}

    async def asks(client: Client) -> None:
        assert (await client("describe", group="rosie.legs", name="turn"))["needs_approval"]
        assert not (await client("describe", group="rosie.legs", name="state"))["needs_approval"]
        await client("lock", group="rosie.legs")
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(run_sync, lambda: _decide(person, "approve"))
            assert await client("call", **call) == {"result": 0.5}
        assert "waits for a person's approval" in client.progress
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(run_sync, lambda: _decide(person, "refuse", "a person is in the way"))
            refusal = await client.refused("call", **{**call, "args": [0.7]})
        assert "ann refused: a person is in the way" in refusal

    run(asks, agent)
    assert robot.legs.angle == 0.5


def test_no_client_approves_its_own_request_or_without_the_right(
    memory: MemorySystem, robot: Robot, governed: Path, agent: Container
) -> None:
    bob, again = memory.container("bob", identity="bob"), memory.container("again", identity="agent")
    for container in (bob, again):
        container.load_policy(governed)
    memory.settle()
    refused: list[BaseException] = []

    def approve(by: Container) -> None:
        try:
            _decide(by, "approve")
        except TradeError as error:
            refused.append(error)

    async def asks(client: Client) -> None:
        await client("lock", group="rosie.legs")
        async with anyio.create_task_group() as tasks:

            async def calls() -> None:
                await client("call", group="rosie.legs", name="turn", args=[0.5])

            tasks.start_soon(calls)
            await run_sync(approve, bob)
            await run_sync(approve, again)
            [waiting] = bob.find(where(name="pending", group="approvals"), wait_s=5)()
            said = await client.refused("call", group="approvals.agent", name="approve", args=[waiting.id])
            assert "AccessDenied" in said
            tasks.cancel_scope.cancel()

    run(asks, agent)
    assert [type(error) for error in refused] == [AccessDenied, AccessDenied]
    assert robot.legs.angle == 0.0


def test_without_a_policy_an_agents_name_does_not_approve_its_own_call_and_another_does(
    memory: MemorySystem, robot: Robot, agent: Container
) -> None:
    again, person = memory.container("again", identity="agent"), memory.container("person", identity="ann")
    memory.settle()
    said: list[str] = []

    def tries() -> None:
        with pytest.raises(AccessDenied) as denied:
            _decide(again, "approve")
        said.append(str(denied.value))

    async def asks(client: Client) -> None:
        await client("lock", group="rosie.legs")
        async with anyio.create_task_group() as tasks:

            async def decides() -> None:
                await run_sync(tries)
                assert robot.legs.angle == 0.0
                await run_sync(_decide, person, "approve")

            tasks.start_soon(decides)
            assert await client("call", group="rosie.legs", name="turn", args=[0.5]) == {"result": 0.5}

    run(asks, agent, ask_first=("rosie.legs",))
    assert "another identity" in said[0]
    assert robot.legs.angle == 0.5


class Joint:
    """A joint of the head, in a group of its own."""

    def __init__(self, part: Part) -> None:
        self.resources = part.resources
        self.angles: list[float] = []

    @service
    def move_to(self, angle: float) -> None:
        self.angles.append(angle)

    @service(effect="stop")
    def stop(self) -> None: ...


def test_a_marked_group_needs_approval_whichever_service_moves_it(
    memory: MemorySystem, robot: Robot, agent: Container
) -> None:
    joint, alias = Joint(robot.head), Part("lamp")
    robot.container.register(joint, "rosie.neck.pan")
    robot.container.register(alias, ["lab.lamp", "rosie.head"])
    memory.settle()
    approvals = Approvals(agent, ("rosie.head",))
    found = {(one.key.domain, one.name): one for one in agent.services(where())}
    assert approvals.needed("agent", found["rosie.neck.pan", "move_to"])
    assert approvals.needed("agent", found["lab.lamp", "turn"])
    assert not approvals.needed("agent", found["rosie.neck.pan", "stop"])
    assert not approvals.needed("agent", found["rosie.legs", "turn"])


def test_without_a_policy_the_command_line_marks(memory: MemorySystem, robot: Robot, agent: Container) -> None:
    person = memory.container("person", identity="ann")
    memory.settle()

    async def asks(client: Client) -> None:
        await client("lock", group="rosie")
        assert await client("call", group="rosie.head", name="turn", args=[0.2]) == {"result": 0.2}
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(run_sync, lambda: _decide(person, "approve"))
            assert await client("call", group="rosie.legs", name="turn", args=[0.5]) == {"result": 0.5}

    run(asks, agent, ask_first=("rosie.legs",))


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ('[approval]\n"agent" = "rosie"', "must be a list of texts"),
        ('[approval]\n"a b" = ["rosie"]', "is no identity"),
        ('[approval]\n"agent" = ["no group!"]', "is no group"),
        ("approval = 1", "must be a table"),
    ],
)
def test_a_mark_that_is_wrong_is_refused_with_the_policy(
    agent: Container, tmp_path: Path, text: str, problem: str
) -> None:
    policy = tmp_path / "policy.toml"
    head, _, _ = POLICY.partition("[approval]")
    policy.write_text(f"{text}\n{head}" if text.startswith("approval") else f"{head}\n{text}\n")
    with pytest.raises(ConfigurationError, match=problem):
        agent.load_policy(policy)
