"""Agents over Streamable HTTP: judged as the client of their token, and stopped when they are gone."""

import json
from collections.abc import Iterator
from contextlib import AsyncExitStack, closing
from functools import partial
from pathlib import Path
from typing import Any

import anyio
import pytest
from anyio.to_thread import run_sync
from mcp import ClientSession, McpError

from tests.support.http_agents import PEER, agent_of, begun_by_hand, rpc, run, used
from tests.support.http_clients import POLICY, Axis, Client, Opened, ask, govern, opened
from tests.support.two_joint_robot import Robot
from tests.support.waiting import wait_until
from trade import service
from trade.testing import memory_system
from trade_drivers import Image
from trade_gateway.clients._clients import MOST_OF_ONE
from trade_gateway.http._http import MOST_BODY_BYTES
from trade_gateway.mcp._pictures import MOST_PICTURE_BYTES

pytestmark = pytest.mark.virtual_time(packages=["httpcore", "httpx", "mcp", "sse_starlette"])

APPROVERS = """
[roles.approver]
call = ["approvals"]
read = ["approvals", "robot"]

[roles.locker]
lock = ["robot"]

[roles.agent]
call = ["approvals", "robot"]
read = ["*"]
lock = ["robot"]
"""
NAMES = 'bert = ["viewer"]\nbot = ["agent"]\ndora = ["approver"]\nlena = ["locker"]\n'
MARKED = '[approval]\n"bot*" = ["robot.a"]\n'


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Opened]:
    """A governed HTTP gateway with agents, in front of joints that move until they are stopped."""
    with memory_system() as system:
        robot = Robot(system)
        axis = robot.joints["axis"] = Axis("axis")
        system.container("axis").register(axis, "robot.a.axis")
        system.settle()
        govern(robot, tmp_path, APPROVERS + POLICY.replace('bert = ["viewer"]\n', NAMES) + MARKED)
        with opened(robot.me, tmp_path, mcp=True) as (gateway, tokens):
            yield Opened(robot, gateway, tokens)
        axis.stopped.set()


def test_an_agent_over_http_may_do_what_its_tokens_client_may_and_nothing_else(served: Opened) -> None:
    async def uses() -> None:
        async with agent_of(served) as anna, agent_of(served, "bert") as bert, agent_of(served, "chief") as chief:
            move = {"group": "robot.a", "name": "move", "args": [1.0]}
            assert (await used(anna, "call", **move)).startswith("NeedsLock")
            taken = await used(anna, "lock", group="robot.a", purpose="to look")
            assert await used(anna, "call", **move) == {"result": 1.0}
            assert (await used(bert, "lock", group="robot.a", wait_s=0)).startswith("AccessDenied")
            assert (await used(anna, "lock", group="robot.b")).startswith("AccessDenied")
            seen = [{one["group"] for one in await used(each, "services", name="move")} for each in (anna, bert)]
            assert seen == [{"robot.a", "robot.a.axis"}, {"robot.a", "robot.a.axis", "robot.b"}]
            locks = (await used(bert, "locks"))["locks"]
            assert {one["owner"].rpartition(" ")[2] for one in locks} == {"anna"}
            assert (await used(anna, "ask", sentence="Who has the axis?")).startswith("AccessDenied")
            assert "to look" in (await used(chief, "ask", sentence="Who has the axis?"))["text"]
            assert await used(anna, "unlock", lock=taken["lock"]) == {"released": True}

    run(uses)
    assert (served["a"].written, served["b"].written) == ([1.0], [])


def test_without_the_setting_there_are_no_agents(tmp_path: Path) -> None:
    with memory_system() as system:
        robot = Robot(system)
        with opened(robot.me, tmp_path) as (gateway, tokens):
            anna = Opened(robot, gateway, tokens).client()
            assert anna.ask("POST", "/mcp", rpc("initialize", **PEER)).status == 404


def test_an_unknown_token_or_another_clients_session_reaches_no_tool(served: Opened) -> None:
    stop = rpc("tools/call", 2, name="estop", arguments={})
    for token in ("", "wrong"):
        refused = Client(served.gateway.url, token).ask("POST", "/mcp", rpc("initialize", **PEER))
        assert (refused.status, refused.title) == (401, "NotAuthenticated")
        assert "Bearer" in refused.headers["www-authenticate"]
    annas = begun_by_hand(served.client())
    for who in ("bert", "chief"):
        stolen = Client(annas.url, served.client(who).token, headers=annas.headers)
        for method, body in (("POST", stop), ("GET", None), ("DELETE", None)):
            assert stolen.ask(method, "/mcp", body).status == 404
    lasting = served.client().opened()
    for name in ("no-such-session", lasting.session):
        assert (
            Client(annas.url, annas.token, headers={**annas.headers, "Mcp-Session-Id": name})
            .ask("POST", "/mcp", stop)
            .title
            == "NoSuchSession"
        )
    assert served.robot.me.estops() == []
    assert annas.ask("DELETE", "/mcp").status == 200


def test_a_page_of_another_site_or_another_host_name_reaches_no_agent(served: Opened) -> None:
    anna = begun_by_hand(served.client())
    stop = rpc("tools/call", 2, name="estop", arguments={})
    for wrong in ({"Origin": "http://evil.example"}, {"Origin": "null"}, {"Host": "evil.example"}):
        for method, body in (("POST", stop), ("GET", None), ("DELETE", None)):
            assert anna.ask(method, "/mcp", body, **wrong).title == "WrongOrigin"
    assert served.robot.me.estops() == []
    assert anna.ask("POST", "/mcp", stop, Origin=served.gateway.url).status == 200
    assert len(served.robot.me.estops()) == 1


def test_bodies_that_are_too_large_or_no_messages_are_refused_and_open_no_session(served: Opened) -> None:
    anna = served.client()
    large = json.dumps(rpc("initialize", **PEER, more="x" * MOST_BODY_BYTES)).encode()
    deep = b'{"jsonrpc":"2.0","id":1,"method":"initialize","params":' + b"[" * 100_000 + b"]" * 100_000 + b"}"
    bad: list[tuple[int, Any]] = [(413, large), (400, deep), (400, b"{"), (400, b"[]"), (400, rpc("tools/list"))]
    for status, body in bad:
        assert anna.ask("POST", "/mcp", body).status == status, body[:80]
    assert anna.ask("GET", "/mcp").status == 400
    assert anna.ask("POST", "/mcp", rpc("initialize", **PEER), Accept="text/html").status == 406
    begun = begun_by_hand(anna)
    assert begun.ask("POST", "/mcp", large).status == 413
    assert begun.ask("POST", "/mcp", deep).status == 400
    assert begun.ask("POST", "/mcp", b'{"jsonrpc": "2.0"').status == 400
    wait_until(lambda: len(list(served.gateway._api.clients)) == 1, "only that session is left")


def test_a_revoked_token_ends_the_agents_session_and_its_motion(served: Opened) -> None:
    async def moves() -> None:
        async with agent_of(served, leaves=False) as anna, anyio.create_task_group() as tasks:
            await _spin(served, anna, tasks)
            served.tokens.write_text("[tokens]\n")
            assert await run_sync(served["axis"].stopped.wait, 30)
            tasks.cancel_scope.cancel()

    run(moves)


async def _spin(served: Opened, agent: ClientSession, tasks: Any) -> None:
    """Have the axis move until it is stopped."""
    await used(agent, "lock", group="robot.a")
    move = {"group": "robot.a.axis", "name": "move_to", "args": [1.0], "deadline_s": 60}
    tasks.start_soon(partial(used, agent, "call", **move))
    assert await run_sync(served["axis"].entered.wait, 30)


@pytest.mark.realtime
@pytest.mark.parametrize("leaves", [True, False])
def test_S03_an_agent_that_vanishes_in_a_move_stops_it_and_loses_its_locks(served: Opened, leaves: bool) -> None:
    async def vanishes() -> None:
        async with agent_of(served, leaves=leaves) as anna, anyio.create_task_group() as tasks:
            await _spin(served, anna, tasks)
            tasks.cancel_scope.cancel()

    run(vanishes)
    assert served["axis"].stopped.wait(30)
    wait_until(lambda: served.robot.me.locks() == [], "its locks are released")


def test_S05_a_move_stops_when_its_connection_ends_although_its_session_continues(served: Opened) -> None:
    anna = begun_by_hand(served.client())
    assert anna.ask("POST", "/mcp", rpc("tools/call", 2, name="lock", arguments={"group": "robot.a"})).status == 200
    move = {"group": "robot.a.axis", "name": "move_to", "args": [1.0], "deadline_s": 60}
    with closing(anna.begin("POST", "/mcp", rpc("tools/call", 3, name="call", arguments=move))):
        assert served["axis"].entered.wait(30)
    assert served["axis"].stopped.wait(30)
    assert anna.ask("POST", "/mcp", rpc("tools/list", 4)).status == 200


@pytest.mark.realtime
def test_S05_an_agent_that_is_connected_and_answers_no_ping_loses_its_motion(served: Opened) -> None:
    anna = begun_by_hand(served.client())
    assert anna.ask("POST", "/mcp", rpc("tools/call", 2, name="lock", arguments={"group": "robot.a"})).status == 200
    move = {"group": "robot.a.axis", "name": "move_to", "args": [1.0], "deadline_s": 60}
    with closing(anna.begin("POST", "/mcp", rpc("tools/call", 3, name="call", arguments=move))):
        assert served["axis"].entered.wait(30)
        assert served["axis"].stopped.wait(30)
        wait_until(lambda: served.robot.me.locks() == [], "its locks are released")
    assert anna.ask("POST", "/mcp", rpc("tools/list", 4)).status == 404


@pytest.mark.realtime
def test_an_agent_that_thinks_and_answers_pings_keeps_its_lock(served: Opened) -> None:
    sent = list[str]()

    async def thinks() -> None:
        async with agent_of(served, sent=sent) as anna:
            taken = await used(anna, "lock", group="robot.a")
            sent.clear()
            await run_sync(wait_until, lambda: sent.count("POST") > 6, "without answers, its lease would be over")
            assert await used(anna, "unlock", lock=taken["lock"]) == {"released": True}

    run(thinks)


@pytest.mark.realtime
def test_fifty_idle_agents_keep_no_other_client_waiting_and_end(served: Opened) -> None:
    names = ["anna", "bert", "chief", "bot"]

    async def idle() -> None:
        async with AsyncExitStack() as agents:
            for number in range(50):
                await agents.enter_async_context(agent_of(served, names[number // MOST_OF_ONE]))
            busy = await run_sync(lambda: served.client("anna").ask("POST", "/mcp", rpc("initialize", **PEER)))
            assert (busy.status, busy.title) == (429, "TooMany")
            assert (await run_sync(served.client("bert").call, "robot.a.stop")).status == 200
            last = await agents.enter_async_context(agent_of(served, "bot"))
            assert "stopped" in (await used(last, "stop", group="robot.a")).values()

    run(idle)
    wait_until(lambda: list(served.gateway._api.clients) == [], "all sessions have ended")


def _approvals(by: Client, word: str, *args: Any) -> Any:
    return by.call(f"approvals.me.{word}", *args)


def _waiting(by: Client) -> str:
    """The id of the request that waits."""
    found = list[Any]()

    def waits() -> bool:
        answer = _approvals(by, "pending")
        found[:] = answer.body["result"] if answer.status == 200 else []
        return bool(found)

    wait_until(waits, "a request waits")
    assert [(one["agent"], one["service"]) for one in found] == [("bot", "robot.a.move")]
    return found[0]["id"]


def test_a_marked_call_of_an_agent_over_http_waits_for_another_client_who_may_administer_it(served: Opened) -> None:
    chief, dora, bot = (served.client(name) for name in ("chief", "dora", "bot"))
    refused = list[int]()

    def decides() -> None:
        name = _waiting(chief)
        refused.extend(_approvals(by, "approve", name).status for by in (dora, bot))
        assert served["a"].written == []
        assert _approvals(chief, "approve", name).status == 200

    async def asks() -> None:
        async with agent_of(served, "bot") as session, anyio.create_task_group() as tasks:
            await used(session, "lock", group="robot.a")
            tasks.start_soon(run_sync, decides)
            move = {"group": "robot.a", "name": "move", "args": [1.0], "why": "to look"}
            assert await used(session, "call", **move) == {"result": 1.0}

    run(asks)
    assert refused == [403, 403]
    assert served["a"].written == [1.0]


def test_without_a_policy_no_token_approves_its_own_call_and_another_does(tmp_path: Path) -> None:
    with memory_system() as system:
        robot = Robot(system)
        with opened(robot.me, tmp_path, mcp=True, ask_first=["robot.a"]) as (gateway, tokens):
            served = Opened(robot, gateway, tokens)
            anna, bot = served.client(), served.client("bot")
            refused = list[int]()

            def decides() -> None:
                name = _waiting(anna)
                refused.append(_approvals(bot, "approve", name).status)
                assert _approvals(anna, "approve", name).status == 200

            async def asks() -> None:
                async with agent_of(served, "bot") as session, anyio.create_task_group() as tasks:
                    await used(session, "lock", group="robot.a")
                    tasks.start_soon(run_sync, decides)
                    assert await used(session, "call", group="robot.a", name="move", args=[1.0]) == {"result": 1.0}

            run(asks)
            assert (refused, robot["a"].written) == ([403], [1.0])


def test_a_marked_identity_makes_marked_calls_over_mcp_only(served: Opened) -> None:
    bot = served.client("bot")
    for group in ("robot.a", "robot.a.axis"):
        refused = bot.call(f"{group}.move", 1.0)
        assert (refused.status, refused.title) == (409, "NeedsApproval")
        with bot.socket() as page:
            answer = ask(page, do="call", id=1, group=group, name="move", args=[1.0])
            assert answer["problem"]["title"] == "NeedsApproval"
    assert (served["a"].written, served["axis"].written) == ([], [])
    assert bot.call("robot.a.where_is_it").body == {"result": 0.0}
    assert bot.call("robot.a.stop").status == 200
    assert served.client("chief").call("robot.a.move", 1.0).status == 200


class Eye:
    """A camera with a picture of the test."""

    def __init__(self, data: bytes, kind: Any = "jpeg") -> None:
        self.data, self.kind, self.taken = data, kind, 0

    @service(effect="read")
    def image(self) -> Image:
        self.taken += 1
        return Image(name="eye", data=self.data, format=self.kind, width_px=2, height_px=2, stamp_ns=1, age_s=0.0)


def test_pictures_are_resources_for_those_who_may_read_them(served: Opened) -> None:
    eye, hidden, huge, raw = (
        Eye(b"\xff\xd8 a picture"),
        Eye(b"?"),
        Eye(bytes(MOST_PICTURE_BYTES + 1)),
        Eye(b"raw", "rgb8"),
    )
    eyes = served.robot.system.container("eyes")
    for one, group in ((eye, "robot.eye"), (hidden, "lab.eye"), (huge, "robot.huge"), (raw, "robot.raw")):
        eyes.register(one, group)
    served.robot.system.settle()

    async def looks() -> None:
        async with agent_of(served, "bert") as bert, agent_of(served) as anna, agent_of(served, "lena") as lena:
            listed = {str(one.uri): one for one in (await bert.list_resources()).resources}
            assert list(listed) == [f"trade://eyes/robot.{name}/image" for name in ("eye", "huge", "raw")]
            for other in (anna, lena):
                assert (await other.list_resources()).resources == []
            assert (eye.taken, hidden.taken) == (0, 0)
            found = [one.uri for one in listed.values()]
            [content] = (await bert.read_resource(found[0])).contents
            assert (content.mimeType, content.blob) == ("image/jpeg", "/9ggYSBwaWN0dXJl")
            for uri, problem in ((found[1], "TooLarge"), (found[2], "InvalidResult")):
                with pytest.raises(McpError, match=problem):
                    await bert.read_resource(uri)
            with pytest.raises(McpError, match="NoSuchService"):
                await anna.read_resource(found[0])
            with pytest.raises(McpError, match="NoSuchService"):
                await bert.read_resource(type(found[0])("trade://eyes/lab.eye/image"))

    run(looks)
    assert (eye.taken, hidden.taken) == (1, 0)
