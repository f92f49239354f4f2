"""The HTTP gateway over HTTP: calls, sessions, locks and stops of clients who speak nothing else (S03, S05, S07)."""

import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from tests.support.certificates import Papers
from tests.support.http_clients import Client, Opened, opened, served_axis
from tests.support.two_joint_robot import Robot
from tests.support.waiting import PATIENCE_S, wait_until
from trade import Handle, Reachability, service, where
from trade.errors import Stopped
from trade.testing import memory_system
from trade_gateway.cli import app
from trade_gateway.http import add_token

pytestmark = pytest.mark.virtual_time


class Lamp:
    def __init__(self, handle: Handle | None = None) -> None:
        self.handle = handle

    @service
    def shine(self, level: float) -> bool:
        return level > 0

    @service(effect="read")
    def picture(self) -> bytes:
        return b"PNG"

    @service(effect="read")
    def which(self) -> Handle | None:
        return self.handle


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Opened]:
    with served_axis(tmp_path) as served:
        yield served


@pytest.mark.parametrize("depth", [90, 200, 500, 900, 2000, 100_000])
@pytest.mark.parametrize("over", ["http", "websocket"])
def test_arguments_that_are_nested_too_deep_are_refused_by_name(
    served: Opened, caplog: pytest.LogCaptureFixture, depth: int, over: str
) -> None:
    class Lathe:
        @service
        def take(self, shape: Any) -> None: ...

    served.robot.me.register(Lathe(), "lathe")
    anna, shape = served.client(), "[" * depth + "]" * depth
    if over == "http":
        answer = anna.ask("POST", "/call/lathe/take", f'{{"args": [{shape}]}}'.encode())
        status, body = answer.status, answer.body
    else:
        with anna.socket() as page:
            page.send(f'{{"do": "call", "id": 1, "group": "lathe", "name": "take", "args": [{shape}]}}')
            reported = json.loads(page.recv(PATIENCE_S))
        body = reported.get("problem", reported)
        status = body.get("status", 200)
    assert status == (200 if depth < 100 else 400), body
    if depth > 100:
        assert body["title"] in ("InvalidArgument", "BadMessage")
    assert "Traceback" not in caplog.text


def test_services_are_listed_and_called_by_place_and_by_name(served: Opened) -> None:
    anna = served.client()
    listed = anna.ask("GET", "/services?group=robot.a&name=mo*").body
    assert [(one["group"], one["name"], one["effect"]) for one in listed] == [("robot.a", "move", "actuate")]
    assert anna.call("robot.a.move", 0.5).body == {"result": 0.5}
    assert anna.ask("POST", "/call/robot.a/move", {"args": {"value": 0.7}, "deadline_s": 5}).body == {"result": 0.7}
    assert anna.ask("POST", "/call/robot.a/where_is_it").body == {"result": 0.7}
    assert served["a"].written == [0.5, 0.7]
    assert {one["name"] for one in anna.ask("GET", "/containers").body} >= {"a", "b", "me"}


@pytest.mark.realtime
def test_the_page_about_it_does_what_it_says(served: Opened) -> None:
    text = (Path(__file__).parents[3] / "docs" / "http.md").read_text(encoding="utf-8")
    [program] = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    served.robot.system.container("lamps").register(Lamp(), "lab.desk")
    served.robot.system.settle()
    environment = {**os.environ, "URL": served.gateway.url, "TOKEN": served.client().token}
    ended = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False, env=environment
    )
    assert ended.stdout.splitlines() == re.findall(r"print\(.*\) +# (.*)", program), ended.stderr


@pytest.mark.realtime
def test_its_program_connects_over_https(tmp_path: Path) -> None:
    text = (Path(__file__).parents[3] / "docs" / "http.md").read_text(encoding="utf-8")
    [program] = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    papers = Papers(tmp_path / "pki").of("page", addresses=["127.0.0.1"])
    with memory_system() as system:
        system.container("lamps").register(Lamp(), "lab.desk")
        system.settle()
        with opened(system.container("me"), tmp_path, tls=papers) as (made, tokens):
            environment = {**os.environ, "URL": made.url, "TOKEN": add_token(tokens, "anna")}
            ended = subprocess.run(
                [sys.executable, "-c", program],
                capture_output=True,
                text=True,
                timeout=60,
                check=False,
                env=environment,
                cwd=papers,
            )
    assert ended.stdout.splitlines() == re.findall(r"print\(.*\) +# (.*)", program), ended.stderr


def test_a_new_token_claims_no_address_that_it_cannot_know(tmp_path: Path) -> None:
    said = CliRunner().invoke(app, ["http", "token", "anna", "--tokens", str(tmp_path / "tokens.toml")]).stdout
    assert "Authorization: Bearer" in said and "127.0.0.1" not in said


def test_services_of_no_group_and_of_one_container_among_several_are_called(served: Opened) -> None:
    system, anna = served.robot.system, served.client()
    system.container("one").register(Lamp(served.robot.find("a")))
    system.container("two").register(Lamp())
    system.settle()
    assert anna.call("_.shine", 0.5).title == "TooManyServices"
    assert anna.call("_.shine", 0.5, container="two").body == {"result": True}
    assert anna.call("_.move", 0.5).title == "NoSuchService"
    assert anna.call("_.picture", container="two").body == {"result": "UE5H"}  # bytes are base64 in JSON
    given = anna.call("_.which", container="one").body["result"]
    assert given == {"service": "robot.a.move", "container": "a"}


def test_errors_are_problems_that_name_the_error_and_what_to_do(served: Opened) -> None:
    anna = served.client()
    refused = anna.call("robot.a.move", "far")
    assert (refused.status, refused.title) == (400, "InvalidArgument")
    assert refused.headers["content-type"] == "application/problem+json"
    assert refused.body["type"] == "urn:trade:InvalidArgument"
    assert refused.body["data"]["argument"] == "value"
    assert "Call it as move(value: float)" in refused.body["detail"]
    assert anna.call("robot.a.fly").title == "NoSuchService"
    assert anna.ask("POST", "/call/robot/move", {"args": [1.0]}).title == "TooManyServices"
    assert anna.ask("POST", "/call/robot.a/move", {"args": [1.0], "dead_line": 1}).title == "BadMessage"
    assert anna.ask("POST", "/call/robot.a/move", b"[").title == "BadMessage"
    assert anna.ask("GET", "/nowhere").status == 404
    assert anna.ask("DELETE", "/services").status == 405
    assert anna.ask("POST", "/estop", b"x", Content_Type="text/plain").status == 415
    assert served["a"].written == []


def test_S03_a_plain_request_is_a_session_and_leaves_nothing_moving(served: Opened) -> None:
    anna = served.client()
    assert anna.call("robot.a.go_on", 1.0).status == 200
    assert served["a"].stopped.wait(20)
    assert served.robot.me.services(where(name="go_on"))  # it is not the HTTP gateway that went


def test_S03_what_a_session_moves_stops_with_it_and_nothing_of_another_does(served: Opened) -> None:
    one, two = served.client("anna").opened(lease_s=60), served.client("bert").opened(lease_s=60)
    one.call("robot.a.go_on", 1.0)
    two.call("robot.b.go_on", 1.0)
    assert served["a"].resource.moving
    assert one.ask("DELETE", "/session").status == 204
    assert served["a"].stopped.wait(20)
    served.robot.system.settle()
    assert served["b"].resource.moving
    gone = one.call("robot.a.go_on", 1.0)
    assert (gone.status, gone.title) == (404, "NoSuchSession")


@pytest.mark.realtime
def test_S05_a_silent_session_ends_and_an_active_one_does_not(served: Opened) -> None:
    heard, silent = served.client("anna").opened(lease_s=2), served.client("bert").opened(lease_s=2)
    heard.call("robot.a.go_on", 1.0)
    silent.call("robot.b.go_on", 1.0)
    until = time.monotonic() + 4
    while time.monotonic() < until:
        assert heard.ask("GET", "/session").status == 200
    assert served["b"].stopped.wait(20)
    assert served["a"].resource.moving
    assert silent.ask("GET", "/session").title == "NoSuchSession"


def test_S05_hanging_up_during_a_call_ends_it(served: Opened) -> None:
    served["a"].hold.clear()
    request = served.client().begin("POST", "/call/robot.a/move", {"args": [1.0], "deadline_s": 300})
    assert served["a"].entered.wait(20)
    request.close()
    assert served["a"].stopped.wait(20)
    served["a"].hold.set()
    wait_until(lambda: not served["a"].resource.calls, "the call has ended")
    assert served["a"].written == []


def test_S05_hanging_up_during_a_call_of_a_session_ends_that_call_and_not_the_session(served: Opened) -> None:
    session = served.client().opened(lease_s=60)
    session.call("robot.b.go_on", 1.0)
    request = session.begin("POST", "/call/robot.axis/move_to", {"args": [1.0], "deadline_s": 300})
    assert served["axis"].entered.wait(20)
    request.close()
    assert served["axis"].stopped.wait(20)
    assert session.ask("GET", "/session").status == 200
    assert served["b"].resource.moving
    session.ask("POST", "/call/robot.axis/go_on", {"args": [1.0]})  # its own stop does not latch (S08)
    assert served["axis"].resource.moving


def test_a_session_belongs_to_its_client_alone(served: Opened) -> None:
    session = served.client("anna").opened(lease_s=60)
    thief = served.client("bert")
    thief.session = session.session
    assert thief.call("robot.a.move", 1.0).title == "NoSuchSession"
    assert thief.ask("DELETE", "/session").title == "NoSuchSession"
    assert session.call("robot.a.move", 2.0).status == 200


def test_a_lock_belongs_to_its_session_and_ends_with_it(served: Opened) -> None:
    anna, bert = served.client("anna"), served.client("bert")
    refused = anna.ask("POST", "/locks", {"group": "robot.a"})
    assert (refused.status, refused.title) == (400, "NeedsSession")
    session = anna.opened(lease_s=60)
    taken = session.ask("POST", "/locks", {"group": "robot", "purpose": "walk"})
    assert taken.status == 201
    assert {"a", "b"} <= set(taken.body["resources"])
    assert session.call("robot.a.move", 1.0).status == 200
    locked = bert.call("robot.a.move", 2.0)
    assert (locked.status, locked.title) == (409, "LockedByOther")
    [shown] = [one for one in bert.ask("GET", "/locks").body if one["resources"] == ["a"]]
    assert (shown["owner"], shown["purpose"]) == ("tester/me for anna", "walk")
    assert bert.opened().ask("DELETE", f"/locks/{taken.body['lock']}").status == 404
    assert session.ask("DELETE", f"/locks/{taken.body['lock']}").status == 204
    assert bert.call("robot.a.move", 3.0).status == 200
    session.ask("POST", "/locks", {"group": "robot.a"})
    session.ask("DELETE", "/session")
    wait_until(lambda: bert.call("robot.a.move", 4.0).status == 200, "it fell")
    assert served["a"].written[:2] == [1.0, 3.0]


def test_S08_a_foreign_stop_latches_until_it_is_resumed(served: Opened) -> None:
    session, bert = served.client("anna").opened(lease_s=60), served.client("bert")
    session.call("robot.a.go_on", 1.0)
    assert bert.call("robot.a.stop").status == 200
    held = session.call("robot.a.go_on", 1.0)
    assert (held.status, held.title) == (409, "Stopped")
    assert session.ask("POST", "/resume", {"group": "robot.a"}).body == {"resumed": ["a"]}
    assert session.call("robot.a.go_on", 1.0).status == 200


def test_S09_an_e_stop_holds_until_it_is_cleared(served: Opened) -> None:
    anna = served.client()
    given = anna.ask("POST", "/estop", {"reason": "smoke"})
    assert given.body["complete"]
    assert set(given.body["confirmed"]) >= {"tester/a", "tester/b"}
    [known] = anna.ask("GET", "/estops").body
    assert (known["id"], known["reason"]) == (given.body["id"], "anna: smoke")
    assert anna.call("robot.a.move", 1.0).title == "Stopped"
    assert anna.ask("POST", "/estop/clear", {"ids": ["nonsense"]}).title == "NoSuchEstop"
    assert anna.ask("POST", "/estop/clear").body["complete"]
    assert anna.call("robot.a.move", 1.0).status == 200


def test_S09_an_http_gateway_that_finds_no_container_does_not_say_that_no_e_stop_is_open(tmp_path: Path) -> None:
    with memory_system() as system, opened(system.container("alone"), tmp_path) as (made, tokens):
        refused = Client(made.url, add_token(tokens, "anna")).ask("POST", "/estop/clear")
        assert (refused.status, refused.title) == (503, "NoContainerFound")


@pytest.mark.realtime
def test_S09_an_e_stop_that_no_container_received_is_no_success_and_stays_open(tmp_path: Path) -> None:
    with memory_system() as system, opened(system.container("alone"), tmp_path) as (made, tokens):
        anna = Client(made.url, add_token(tokens, "anna"))
        sight = anna.ask("GET", "/sight").body
        assert (sight["others"], sight["silent"], sight["apart"]) == ([], [], {})
        refused = anna.ask("POST", "/estop", {"reason": "smoke"})
        assert (refused.status, refused.title) == (503, "NoContainerFound")
        assert "use the switch that cuts the power" in refused.body["detail"]
        [known] = anna.ask("GET", "/estops").body
        assert known["id"] in refused.body["detail"]
        robot = Robot(system)  # a container that appears gets the e-stop
        move = robot.find("a")

        def stopped() -> bool:
            with suppress(Stopped):
                move(1.0)
                return False
            return True

        wait_until(stopped, "it has heard of the e-stop")


def test_S09_an_http_gateway_names_unreached_containers_and_calls_the_e_stop_incomplete(
    served: Opened, monkeypatch: pytest.MonkeyPatch
) -> None:
    anna = served.client()
    assert anna.ask("GET", "/sight").body["apart"] == {}
    apart = {"tls/10.0.0.7:7450": "nothing accepts connections there"}
    monkeypatch.setattr(served.robot.me, "reachability", lambda **_: Reachability(("tester/a",), unreached=apart))
    reported = anna.ask("POST", "/estop").body
    assert (reported["complete"], reported["apart"]) == (False, apart)
    assert set(reported["confirmed"]) >= {"tester/a", "tester/b"}


def test_S07_under_overload_some_calls_are_refused_and_a_stop_is_not(served: Opened) -> None:
    anna, bert = served.client("anna"), served.client("bert")
    under_way: list[HTTPConnection] = []

    def full() -> bool:
        under_way.append(anna.begin("POST", "/call/robot.axis/move_to", {"args": [1.0], "deadline_s": 300}))
        return anna.call("robot.b.where_is_it").status == 429

    try:
        wait_until(full, "it is full")
        assert anna.call("robot.b.where_is_it").title == "TooMany"
        assert bert.call("robot.b.where_is_it").status == 200
        assert not served["axis"].stopped.is_set()
        assert anna.call("robot.axis.stop").status == 200
        assert served["axis"].stopped.is_set()
    finally:
        for request in under_way:
            request.close()


def test_S07_a_stop_needs_no_session_not_even_the_one_it_names(served: Opened) -> None:
    ended, bert = served.client("anna").opened(lease_s=60), served.client("bert").opened(lease_s=60)
    ended.ask("DELETE", "/session")
    bert.call("robot.a.go_on", 1.0)
    assert ended.call("robot.a.go_on", 1.0).title == "NoSuchSession"
    assert ended.call("robot.a.stop").status == 200
    assert not served["a"].resource.moving
    assert ended.ask("POST", "/estop").body["complete"]


def test_what_is_too_large_is_refused(served: Opened) -> None:
    answer = served.client().ask("POST", "/estop", b" " * (2 << 20))
    assert (answer.status, answer.title) == (413, "TooLarge")


def test_one_client_has_so_many_sessions_and_no_more(served: Opened) -> None:
    anna = served.client()
    sessions = [anna.opened(lease_s=60) for _ in range(16)]
    full = anna.ask("POST", "/session")
    assert (full.status, full.title) == (429, "TooMany")
    assert served.client("bert").ask("POST", "/session").status == 201
    sessions[0].ask("DELETE", "/session")
    assert anna.ask("POST", "/session").status == 201
