"""Who is let in, as whom, and what the policy lets that one do: the client is judged, not the HTTP gateway (S21)."""

import logging
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.http_clients import POLICY, Client, Opened, ask, govern, governed, heard, say
from tests.support.waiting import wait_until
from trade._audit.events import Event
from trade._audit.hash_chain import AuditRow
from trade._audit.store import AuditStore
from trade.errors import ConfigurationError
from trade_gateway.clients._system_info import newest

pytestmark = pytest.mark.virtual_time


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Opened]:
    with governed(tmp_path) as made:
        yield made


def test_a_client_has_its_own_rights_and_not_those_of_the_http_gateway(served: Opened) -> None:
    anna, bert = served.client("anna"), served.client("bert")
    assert anna.call("robot.a.move", 1.0).status == 200
    denied = bert.call("robot.a.move", 2.0)
    assert (denied.status, denied.title) == (403, "AccessDenied")
    assert denied.body["data"]["who"] == "bert"
    assert "no rule of role viewer allows call in robot.a" in denied.body["detail"]
    assert bert.call("robot.a.where_is_it").body == {"result": 1.0}
    assert served["a"].written == [1.0]


def test_a_client_does_not_see_what_it_may_not_read(served: Opened) -> None:
    anna, stranger = served.client("anna"), served.client("carl")
    assert {one["group"] for one in anna.ask("GET", "/services").body} == {"robot.a"}
    assert anna.call("robot.b.move", 1.0).title == "NoSuchService"
    assert "/call/robot.b/move" not in anna.ask("GET", "/openapi.json").body["paths"]
    assert stranger.ask("GET", "/services").body == []
    with served.robot.me.lock([served.robot.find("b")]):
        assert anna.ask("GET", "/locks").body == []
    with anna.socket() as page:
        say(page, do="watch", id=1, name="move", existing=True, occasions=["joined"])
        assert heard(page)["service"]["group"] == "robot.a"
        served.robot.system.container("b").deregister(served["b"])
        served.robot.system.container("b").register(
            served["b"], ["robot.b", "robot.a"]
        )  # its first group is what counts
        served.robot.system.container("a").deregister(served["a"])
        served.robot.system.container("a").register(served["a"], "robot.a.again")
        assert heard(page)["service"]["group"] == "robot.a.again"


def test_a_client_without_a_role_reads_nothing_of_the_system(served: Opened) -> None:
    bert, stranger = served.client("bert"), served.client("carl")
    for path in ("/containers", "/loads", "/sight", "/estops"):
        assert bert.ask("GET", path).status == 200
        refused = stranger.ask("GET", path)
        assert (refused.status, refused.title) == (403, "AccessDenied"), path
    assert stranger.ask("POST", "/estop", {"reason": "smoke"}).status == 200  # to stop needs no role (S07)


def test_locks_resuming_and_clearing_are_the_clients_rights_too(served: Opened) -> None:
    anna, bert, chief = (served.client(name).opened(lease_s=60) for name in ("anna", "bert", "chief"))
    assert bert.ask("POST", "/locks", {"group": "robot.a"}).title == "AccessDenied"
    assert anna.ask("POST", "/locks", {"group": "robot"}).title == "AccessDenied"
    assert anna.ask("POST", "/locks", {"group": "trade"}).title == "AccessDenied"
    assert anna.ask("POST", "/locks", {"group": "robot.z", "wait_s": 60}).title == "NoSuchService"
    taken = anna.ask("POST", "/locks", {"group": "robot.a"})
    anna.call("robot.a.go_on", 1.0)
    assert bert.call("robot.a.stop").status == 200  # a stop needs no role
    assert anna.call("robot.a.go_on", 1.0).title == "Stopped"
    assert bert.ask("POST", "/resume", {"group": "robot.a"}).title == "AccessDenied"
    assert anna.ask("POST", "/resume", {"group": "robot.a"}).body == {"resumed": ["a"]}  # it is its lock
    anna.call("robot.a.go_on", 1.0)
    anna.ask("DELETE", f"/locks/{taken.body['lock']}")
    bert.call("robot.a.stop")
    assert anna.ask("POST", "/resume", {"group": "robot.a"}).title == "AccessDenied"
    assert chief.ask("POST", "/resume", {"group": "robot.a"}).body == {"resumed": ["a"]}
    given = bert.ask("POST", "/estop").body
    assert given["complete"]
    assert anna.ask("POST", "/estop/clear", {"ids": [given["id"]]}).title == "AccessDenied"
    assert chief.ask("POST", "/estop/clear", {"ids": [given["id"]]}).body["complete"]


def test_refusals_and_the_client_that_cleared_an_e_stop_are_on_record(
    served: Opened, monkeypatch: pytest.MonkeyPatch
) -> None:
    reported: list[Event] = []
    monkeypatch.setattr(served.robot.me._parts.audit, "_tell", reported.append)
    bert, chief = served.client("bert"), served.client("chief")
    bert.call("robot.a.move", 2.0)
    with bert.socket() as page:
        ask(page, do="call", id=1, group="robot.a", name="move", args=[1.0])
    given = bert.ask("POST", "/estop").body
    bert.ask("POST", "/estop/clear", {"ids": [given["id"]]})
    chief.ask("POST", "/estop/clear", {"ids": [given["id"]]})
    refused = [(one.who, one.what, one.outcome) for one in reported if one.kind == "refused"]
    move, clear = ("robot.a.move", "AccessDenied"), (f"e-stop {given['id']}", "AccessDenied")
    assert refused == [("bert", *move), ("bert", *move), ("bert", *clear)]
    assert "no rule of role viewer" in reported[0].why
    assert [(one.who, one.about) for one in reported if one.what == "e-stop clearing"] == [("chief", given["id"])]
    Client(served.gateway.url, "not a token").ask("GET", "/services")
    assert len([one for one in reported if one.kind == "refused"]) == 3  # else anybody could fill the record


def test_a_client_learns_its_identity_and_rights(served: Opened) -> None:
    anna, bert, chief = (served.client(name) for name in ("anna", "bert", "chief"))
    may_nothing = {"administers": False, "reads": False, "instruments": False}
    assert anna.ask("GET", "/me").body == {"identity": "anna", **may_nothing, "over": []}
    assert chief.ask("GET", "/me").body == {"identity": "chief", **dict.fromkeys(may_nothing, True), "over": ["*"]}
    may = {one["name"]: one["allowed"] for one in bert.ask("GET", "/services?group=robot.a").body}
    assert (may["where_is_it"], may["move"], may["stop"]) == (True, False, True)
    assert all(one["allowed"] for one in anna.ask("GET", "/services").body)


def test_readers_request_locks_and_administrators_break_them(served: Opened) -> None:
    anna, bert, carl, chief = (served.client(name).opened(lease_s=60) for name in ("anna", "bert", "carl", "chief"))
    asked: list[tuple[str, str]] = []
    own = served.robot.me.lock([served.robot.find("a")], on_request=lambda who, why: asked.append((who, why))).acquire()
    wanted = {"resources": ["a"], "reason": "lunch"}
    assert bert.ask("POST", "/locks/request", wanted).body == {"asked": ["tester/me"]}
    wait_until(lambda: bool(asked))
    assert asked[0][1] == "bert: lunch"
    assert carl.ask("POST", "/locks/request", wanted).title == "NoSuchService"
    assert bert.ask("POST", "/locks/request", {"resources": ["b", "none"]}).body == {"asked": []}
    assert anna.ask("POST", "/locks/break", wanted).title == "AccessDenied"
    assert own.held
    assert [one["resources"] for one in chief.ask("POST", "/locks/break", wanted).body] == [["a"]]
    wait_until(lambda: not own.held)
    assert anna.ask("GET", "/locks").body == []
    own.release()


def test_load_is_for_all_clients_and_subscriptions_are_for_readers_of_the_system(served: Opened) -> None:
    anna, chief = served.client("anna"), served.client("chief")
    assert {one["container"] for one in anna.ask("GET", "/loads").body} >= {"a", "b"}
    watching = served.robot.me.every(s=60, call=served.robot.find("a", "where_is_it"))
    hook = served.robot.me.before_service(served.robot.find("a"), served.robot.find("a", "where_is_it"))
    assert watching.id in [one["id"] for one in chief.ask("GET", "/notifications").body]
    assert [one["id"] for one in chief.ask("GET", "/hooks").body] == [hook.id]
    for path in ("/notifications", "/hooks", "/policy", "/audit"):
        assert anna.ask("GET", path).title == "AccessDenied"
    assert anna.ask("POST", "/tracing", {"on": True}).title == "AccessDenied"
    with anna.socket() as page:
        say(page, do="watch", id=1, existing=True)
        heard(page)
        calls = [one["call"] for one in chief.ask("GET", "/notifications").body]
        assert calls.count("notify anna (a client of the HTTP gateway)") == 3
    hook.detach()
    watching.cancel()


def test_the_log_is_sent_line_by_line_to_clients_that_read_the_system(served: Opened) -> None:
    with served.client("chief").socket() as page:
        say(page, do="logs", id=1, level=30)
        served.robot.system.settle()
        logging.getLogger("trade").info("not this one")
        logging.getLogger("trade").warning("the lamp is hot")
        while "the lamp is hot" not in (line := heard(page)["line"])["text"]:
            assert line["level"] >= 30
        say(page, do="cancel", id=2, which=1)
        while (reported := heard(page)).get("id") != 2:
            pass
        assert reported["result"] == {"cancelled": True}
    with served.client("anna").socket() as page:
        assert ask(page, do="logs", id=1)["problem"]["title"] == "AccessDenied"


def test_a_client_that_reads_the_system_sees_its_policy(served: Opened) -> None:
    chief = served.client("chief")
    reported = chief.ask("GET", "/policy").body
    assert (reported["governed"], reported["revoked"]) == (True, [])
    anna = next(one for one in reported["identities"] if one["name"] == "anna")
    assert (anna["roles"], anna["rights"]["call"], anna["rights"]["administer"]) == (["operator"], ["robot.a"], [])


def test_traced_calls_are_reported_as_they_end_to_clients_that_read_the_system(served: Opened) -> None:
    anna, chief = served.client("anna"), served.client("chief")
    assert "a" in chief.ask("POST", "/tracing", {"on": True}).body["containers"]
    try:
        with chief.socket() as page:
            say(page, do="calls", id=1)
            for number in (1.0, 2.0):  # earlier calls are shown at most once, new ones are shown, too
                anna.call("robot.a.where_is_it")
                anna.call("robot.a.move", number)
                reported = [heard(page)["call"] for _ in ("asked", "served")]
                assert {one["service"] for one in reported} == {"robot.a.move"}
                assert {one["side"] for one in reported} == {"asked", "served"}
                assert len({one["id"] for one in reported}) == 1
                assert all("/anna." in one["session"] for one in reported)
            say(page, do="cancel", id=2, which=1)
            assert {(reported := heard(page))["id"]: reported["result"] for _ in "12"} == {
                1: None,
                2: {"cancelled": True},
            }
            say(page, do="calls", id=3, reads=True)
            assert heard(page)["call"]["service"] == "robot.a.where_is_it"
        with anna.socket() as page:
            assert ask(page, do="calls", id=1)["problem"]["title"] == "AccessDenied"
    finally:
        chief.ask("POST", "/tracing", {"on": False})


def test_the_newest_rows_of_all_audit_records_of_a_folder_are_shown_newest_first(tmp_path: Path) -> None:
    for name, times in (("a", (1, 3, 5)), ("b", (2, 4))):
        store = AuditStore(tmp_path / f"{name}.sqlite")
        store.add(
            [AuditRow(0, at, 1, "boot", "call", f"{at}", "", "anna", "", 2**63 - 1, 0, "ok", "", 5) for at in times]
        )
        store.close()
    found = newest(tmp_path, 3)
    assert [(one.container, one.what) for one in found] == [("a", "5"), ("b", "4"), ("a", "3")]
    assert found[0].call_id == "9223372036854775807"
    (tmp_path / "c.sqlite").write_bytes(b"not at all" * 100)
    with pytest.raises(ConfigurationError, match="cannot be read"):
        newest(tmp_path, 3)


def test_functions_of_the_middleware_are_not_callable_over_http(served: Opened) -> None:
    """They would be judged as the HTTP gateway's."""
    chief = served.client("chief")
    assert chief.ask("POST", "/call/trade/terminate_container", {"args": ["x"]}).title == "NoSuchService"
    assert not [one for one in chief.ask("GET", "/services").body if one["group"] == "trade"]


def test_streams_are_the_clients_rights_too_and_end_with_them(served: Opened, tmp_path: Path) -> None:
    with served.client("bert").socket() as page:
        page.send('{"do": "stream", "id": 1, "group": "robot.a", "name": "where_is_it", "hz": 50}')
        assert page.recv(timeout=60)
        govern(served.robot, tmp_path, POLICY.replace('read = ["robot"]', 'read = ["robot.b"]'))
        while b"problem" not in (reported := page.recv(timeout=60, decode=False)):
            pass
        assert b"AccessDenied" in reported
        denied = ask(page, do="stream", id=2, group="robot.a", name="where_is_it")
        assert denied["problem"]["title"] == "NoSuchService"


def test_a_revoked_client_is_not_let_in_and_what_it_moves_stops(served: Opened, tmp_path: Path) -> None:
    anna = served.client("anna")
    with anna.socket() as page:
        ask(page, do="call", id=1, group="robot.a", name="go_on", args=[1.0])
        (tmp_path / "revoked.toml").write_text('revoked = ["anna"]\n')
        govern(served.robot, tmp_path, 'revoked_file = "revoked.toml"\n' + POLICY)
        assert served["a"].stopped.wait(20)
    refused = anna.ask("GET", "/services")
    assert (refused.status, refused.title) == (403, "AccessDenied")


def test_an_unidentified_client_is_admitted_only_if_the_policy_names_anonymous(served: Opened, tmp_path: Path) -> None:
    unknown = Client(served.gateway.url)
    answer = unknown.ask("GET", "/services")
    assert (answer.status, answer.title) == (401, "NotAuthenticated")
    assert answer.headers["www-authenticate"].startswith("Bearer")
    govern(served.robot, tmp_path, POLICY + '"*" = ["viewer"]\n')
    assert unknown.ask("POST", "/estop").status == 401  # a pattern means those whom one knows
    govern(served.robot, tmp_path, POLICY + 'anonymous = ["viewer"]\n')
    assert unknown.call("robot.a.where_is_it").status == 200
    assert unknown.call("robot.a.move", 1.0).title == "AccessDenied"
    unknown.token = "guess"
    assert unknown.ask("GET", "/services").status == 401


def test_each_request_without_a_token_is_refused_whatever_it_asks_for(served: Opened) -> None:
    paths = Client(served.gateway.url, served.client().token).ask("GET", "/openapi.json").body["paths"]
    asked = 0
    for path, operations in paths.items():
        for method in operations:
            body = None if method in ("get", "delete") else {}
            assert Client(served.gateway.url).ask(method.upper(), path.replace("{lock}", "x"), body).status == 401
            asked += 1
    assert asked > 15
