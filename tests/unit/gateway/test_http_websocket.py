"""The HTTP gateway over a WebSocket: one connection is one session, and ends as one (S03, S05)."""

import base64
import os
import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from urllib.parse import urlsplit

import msgspec
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from tests.support.http_clients import Client, Opened, ask, heard, say, served_axis
from tests.support.waiting import PATIENCE_S, wait_until
from trade import progress, service
from trade.protocol.messages import decode_call
from trade.transport.memory.network import InFlightMessage

pytestmark = pytest.mark.virtual_time


class Walker:
    @service
    def walk(self, steps: int) -> int:
        for step in range(steps):
            progress(step)
            threading.Event().wait(0.05)
        return steps

    @service(effect="read")
    def look(self) -> str:
        return "." * 300_000

    @service(effect="read")
    def map(self) -> dict[tuple[int, int], str]:
        return {(0, 0): "here"}


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Opened]:
    with served_axis(tmp_path) as served:
        yield served


def go_on(name: str = "a", number: int = 1) -> dict[str, object]:
    return {"do": "call", "id": number, "group": f"robot.{name}", "name": "go_on", "args": [1.0]}


def test_calls_and_their_errors_are_answered_under_their_ids(served: Opened) -> None:
    with served.client().socket() as page:
        say(page, do="call", id="slow", group="robot.axis", name="move_to", args={"value": 2.0}, deadline_s=60)
        moved = ask(page, do="call", id=1, group="robot.a", name="move", args=[1.0])
        assert moved == {"id": 1, "result": 1.0}
        refused = ask(page, do="call", id=2, group="robot.a", name="move", args=["far"])
        assert refused["problem"]["title"] == "InvalidArgument"
        say(page, do="call", id=3, group="robot.axis", name="stop")
        reported = [heard(page), heard(page)]  # the call that the stop ends may be answered before the stop is
        assert {"id": 3, "result": None} in reported
        assert {"id": "slow", "result": 2.0} in reported


def test_a_call_reports_its_progress(served: Opened) -> None:
    served.robot.system.container("walker").register(Walker(), "walker")
    served.robot.system.settle()
    with served.client().socket() as page:
        say(page, do="call", id=1, group="walker", name="walk", args=[3])
        reported = [heard(page)]
        while "progress" in reported[-1]:
            reported.append(heard(page))
        assert reported[-1] == {"id": 1, "result": 3}
        assert [one["progress"] for one in reported[:-1]] == sorted(one["progress"] for one in reported[:-1])
        assert reported[:-1]


def test_a_result_that_json_cannot_express_ends_one_call_and_nothing_else(served: Opened) -> None:
    served.robot.system.container("walker").register(Walker(), "walker")
    served.robot.system.settle()
    with served.client().socket() as page:
        reported = ask(page, do="call", id=1, group="walker", name="map")
        assert reported["problem"]["title"] == "InvalidResult"
        say(page, do="stream", id=2, group="walker", name="map")
        assert heard(page)["failed"]["title"] == "InvalidResult"
        assert ask(page, **go_on(number=3))["result"] is None
    refused = served.client("bert").call("walker.map")
    assert (refused.status, refused.title) == (502, "InvalidResult")


def test_S04_set_points_leave_in_the_order_in_which_they_came(served: Opened) -> None:
    wanted, left = [float(number) for number in range(60)], list[float]()

    def note(passage: InFlightMessage) -> None:
        if passage.key.startswith("call/") and passage.payload is not None and not passage.arrived:
            call = decode_call(passage.payload)
            left.extend(msgspec.msgpack.decode(call.args) if call.service == "move" else ())

    served.robot.system.tap(note)
    with served.client().socket() as page:
        ask(page, **go_on())  # a container's clock is asked for before the first call to it
        for number, value in enumerate(wanted, 1):
            say(page, do="call", id=number, group="robot.a", name="move", args=[value])
            if number % 15 == 0:  # so many may be under way
                assert all("result" in heard(page) for _ in range(15))
    assert left == wanted


def test_S08_a_call_made_before_a_stop_never_begins_after_it(served: Opened) -> None:
    """All of it is sent at once: the stop overtakes what has not begun."""
    with served.client().socket() as page:
        ask(page, **go_on(number=0))
        for number in range(1, 11):
            say(page, **go_on(number=number))
        say(page, do="call", id="stop", group="robot.a", name="stop")
        reported = [heard(page) for _ in range(11)]
        assert {"id": "stop", "result": None} in reported
        served.robot.system.settle()
        wait_until(lambda: not served["a"].resource.calls, "all have ended")
        assert not served["a"].resource.moving
        assert ask(page, **go_on(number=20))["result"] is None  # what comes after it does
        assert served["a"].resource.moving


def test_an_unreadable_message_is_answered_and_ends_nothing(served: Opened) -> None:
    with served.client().socket() as page:
        for nonsense in ("[", '{"do": "dance", "id": 1}', '{"do": "call", "id": 1}', '{"do":"estop","id":1,"x":2}'):
            page.send(nonsense)
            reported = heard(page)
            assert reported["problem"]["title"] == "BadMessage"
        page.send(b"\x00")
        assert heard(page)["problem"]["title"] == "BadMessage"
        assert ask(page, **go_on())["result"] is None


class Slow:
    """Its stop takes until it is let go."""

    def __init__(self) -> None:
        self.go_on = self.stopped = self.hold = threading.Event()
        self.inside = self.most = self.stops = 0

    @service
    def go(self) -> None: ...

    @service(effect="stop")
    def stop(self) -> None:
        self.stops += 1
        self.inside += 1
        self.most = max(self.most, self.inside)
        self.go_on.wait(30)
        self.inside -= 1


def test_S07_further_stops_of_one_page_share_the_next_one_and_all_are_answered(served: Opened) -> None:
    slow, many = Slow(), 400
    served.robot.joints["slow"] = slow  # type: ignore[assignment]
    served.robot.system.container("slow").register(slow, "robot.slow")
    served.robot.system.settle()
    before = threading.active_count()
    with served.client().socket() as page:
        for number in range(many):
            say(page, do="call", id=number, group="robot.slow", name="stop")
        say(page, do="call", id="seen", group="robot.a", name="where_is_it")
        reported = [heard(page)]
        while reported[-1]["id"] != "seen":
            reported.append(heard(page))
        refused = [one["id"] for one in reported if "problem" in one]
        assert len(refused) > 100  # beyond those whose answer may be waited for; they are carried out all the same
        assert threading.active_count() - before < 40
        wait_until(lambda: slow.inside == 4, "as many run as may run at once")
        assert slow.stops == 4
        slow.go_on.set()
        reported += [heard(page) for _ in range(many + 1 - len(reported))]
        assert {one["id"] for one in reported} == {*range(many), "seen"}
        assert {one["problem"]["title"] for one in reported if "problem" in one} == {"TooMany"}
        assert slow.stops == 5  # begun after the last of them had come
        assert slow.most <= 4
        assert ask(page, do="call", id="again", group="robot.slow", name="stop") == {"id": "again", "result": None}


def test_S05_what_a_page_moves_stops_when_it_closes_and_nothing_else_does(served: Opened) -> None:
    with served.client("bert").socket() as other:
        ask(other, **go_on("b"))
        with served.client().socket() as page:
            ask(page, **go_on())
            assert served["a"].resource.moving
        assert served["a"].stopped.wait(20)
        assert served["b"].resource.moving


def test_S05_a_call_ends_with_the_page_that_made_it(served: Opened) -> None:
    served["a"].hold.clear()
    with served.client().socket() as page:
        say(page, do="call", id=1, group="robot.a", name="move", args=[1.0], deadline_s=300)
        assert served["a"].entered.wait(20)
    assert served["a"].stopped.wait(20)
    served["a"].hold.set()
    wait_until(lambda: not served["a"].resource.calls, "the call has ended")
    assert served["a"].written == []


@pytest.mark.realtime
def test_S05_a_frozen_page_is_dropped_although_its_connection_is_open(served: Opened) -> None:
    """It answers no pings and takes nothing more; a stream fills what lies between."""
    served.robot.system.container("walker").register(Walker(), "walker")
    served.robot.system.settle()
    with _Frozen(served.client()) as page:
        page.send(b'{"do":"call","id":1,"group":"robot.a","name":"go_on","args":[1.0]}')
        page.send(b'{"do":"stream","id":2,"group":"walker","name":"look","hz":1000}')
        wait_until(lambda: served["a"].resource.moving, "it moves")
        assert served["a"].stopped.wait(PATIENCE_S)


def test_a_call_is_cancelled_by_its_id(served: Opened) -> None:
    with served.client().socket() as page:
        say(page, do="call", id=1, group="robot.axis", name="move_to", args=[1.0], deadline_s=300)
        assert served["axis"].entered.wait(20)
        assert ask(page, do="cancel", id=2, which=1)["result"] == {"cancelled": True}
        assert served["axis"].stopped.is_set()
        assert ask(page, do="cancel", id=3, which="nothing")["result"] == {"cancelled": False}


def test_a_lock_belongs_to_its_page_and_ends_with_it(served: Opened) -> None:
    bert = served.client("bert")
    with served.client().socket() as page:
        taken = ask(page, do="lock", id=1, group="robot", purpose="walk")["result"]
        assert ask(page, **go_on())["result"] is None
        assert bert.call("robot.a.move", 1.0).title == "LockedByOther"
        assert ask(page, do="unlock", id=2, lock=taken["lock"])["result"] == {"released": True}
        assert ask(page, do="unlock", id=3, lock=taken["lock"])["result"] == {"released": False}
        ask(page, do="lock", id=4, group="robot.b")
    wait_until(lambda: bert.call("robot.b.move", 1.0).status == 200, "it fell")


def test_a_page_hears_that_its_lock_is_lost_and_does_nothing_until_it_knows(served: Opened) -> None:
    with served.client().socket() as page:
        taken = ask(page, do="lock", id=1, group="robot.a")["result"]
        served.robot.me.break_lock([served.robot.find("a")], "it is needed")
        reported = heard(page)
        assert (reported["event"], reported["lock"]) == ("lock_lost", taken["lock"])
        assert reported["problem"]["title"] == "LockLost"
        assert ask(page, **go_on())["problem"]["title"] == "LockLost"
        assert not served["a"].resource.moving
        ask(page, do="unlock", id=2, lock=taken["lock"])
        assert ask(page, **go_on())["result"] is None


def test_a_stream_is_heard_until_it_is_ended(served: Opened) -> None:
    with served.client().socket() as page:
        say(page, do="stream", id=1, group="robot.a", name="where_is_it", hz=100)
        assert heard(page)["sample"]["value"] == 0.0
        served["a"].written.append(0.5)
        while heard(page)["sample"]["value"] != 0.5:
            pass
        assert ask(page, do="cancel", id=2, which=1)["result"] == {"cancelled": True}
        refused = ask(page, do="stream", id=3, group="robot.a", name="move")
        assert refused["problem"]["title"] == "ConfigurationError"


def test_a_stream_ends_with_its_service(served: Opened) -> None:
    with served.client().socket() as page:
        say(page, do="stream", id=1, group="robot.a", name="where_is_it", hz=10)
        heard(page)
        served.robot.system.container("a").deregister(served["a"])
        while "problem" not in (reported := heard(page)):
            pass
        assert reported["problem"]["title"] == "ServiceGone"


def test_services_that_come_and_go_are_reported(served: Opened) -> None:
    with served.client().socket() as page:
        say(page, do="watch", id=1, group="robot", name="move", existing=True, occasions=["joined", "left"])
        there = sorted(heard(page)["service"]["group"] for _ in range(3))
        assert there == ["robot.a", "robot.axis", "robot.b"]
        served.robot.system.container("b").deregister(served["b"])
        reported = heard(page)
        assert (reported["id"], reported["event"], reported["service"]["group"]) == (1, "left", "robot.b")
        served.robot.system.container("b").register(served["b"], "robot.c")
        assert heard(page)["service"]["group"] == "robot.c"
        assert ask(page, do="cancel", id=2, which=1)["result"] == {"cancelled": True}


def test_S07_a_page_with_all_it_may_have_under_way_can_stop(served: Opened) -> None:
    with served.client().socket() as page:
        for number in range(64):
            say(page, do="watch", id=number, occasions=["left"])
        full = ask(page, do="call", id="more", group="robot.a", name="where_is_it")
        assert full["problem"]["title"] == "TooMany"
        assert ask(page, do="call", id="stop", group="robot.a", name="stop") == {"id": "stop", "result": None}
        assert ask(page, do="estop", id="all", reason="smoke")["result"]["complete"]
        assert ask(page, do="cancel", id="less", which=0)["result"] == {"cancelled": True}


def test_a_message_that_is_too_large_ends_the_connection_and_what_it_moves(served: Opened) -> None:
    with served.client().socket() as page:
        ask(page, **go_on())
        with suppress(ConnectionClosed):  # before all of it was sent
            page.send(" " * (2 << 20))
        with pytest.raises(ConnectionClosed) as why:
            heard(page)
        assert why.value.rcvd is None or why.value.rcvd.code == 1009
        assert served["a"].stopped.wait(20)


def test_pages_show_their_token_as_a_subprotocol(served: Opened) -> None:
    anna = served.client()
    url = anna.url.replace("http", "ws") + "/ws"
    with connect(url, subprotocols=["trade.v1", f"bearer.{anna.token}"]) as page:  # type: ignore[list-item]
        assert page.subprotocol == "trade.v1"
        assert ask(page, **go_on())["result"] is None
    for refused, status in ((["trade.v1"], 401), (["trade.v1", "bearer.guess"], 401)):
        with pytest.raises(InvalidStatus) as why:
            connect(url, subprotocols=refused)  # type: ignore[arg-type]
        assert why.value.response.status_code == status
        assert b"NotAuthenticated" in why.value.response.body


def test_a_page_of_another_site_is_not_let_in(served: Opened) -> None:
    with pytest.raises(InvalidStatus) as why:
        served.client().socket(origin="http://evil.example")
    assert why.value.response.status_code == 403
    assert b"WrongOrigin" in why.value.response.body


def test_revoking_a_token_ends_its_connections(served: Opened) -> None:
    with served.client().socket() as page:
        ask(page, **go_on())
        served.tokens.write_text("[tokens]\n")
        assert served["a"].stopped.wait(20)
        with pytest.raises(ConnectionClosed):
            heard(page)


def test_a_closing_http_gateway_leaves_nothing_moving(served: Opened) -> None:
    with served.client().socket() as page:
        ask(page, **go_on())
        served.gateway.close()
        assert served["a"].stopped.wait(20)


@pytest.mark.realtime
def test_a_connection_that_asks_nothing_is_closed(served: Opened, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trade_gateway.http._protocols._REQUEST_WITHIN_S", 0.5)
    place = urlsplit(served.gateway.url)
    with socket.create_connection((place.hostname, place.port), timeout=PATIENCE_S) as idle:  # type: ignore[arg-type]
        idle.sendall(b"GET /services HTTP/1.1\r\n")
        assert idle.recv(1) == b""
    with served.client().socket() as page:
        say(page, do="stream", id=1, group="robot.a", name="where_is_it", hz=20)
        numbers = [heard(page)["sample"]["number"] for _ in range(30)]  # longer than that
        assert numbers == sorted(numbers)


class _Frozen:
    """A client that says what it wants and then neither reads nor answers, as a process that was stopped."""

    def __init__(self, client: Client) -> None:
        place = urlsplit(client.url)
        self._socket = socket.create_connection((place.hostname, place.port), timeout=PATIENCE_S)  # type: ignore[arg-type]
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        key = base64.b64encode(os.urandom(16)).decode()
        self._socket.sendall(
            f"GET /ws HTTP/1.1\r\nHost: {place.netloc}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n"
            f"Authorization: Bearer {client.token}\r\n\r\n".encode()
        )
        answer = b""
        while b"\r\n\r\n" not in answer:
            answer += self._socket.recv(1)
        assert answer.startswith(b"HTTP/1.1 101")

    def send(self, text: bytes) -> None:
        """One masked text frame of fewer than 126 bytes; the mask is nought."""
        self._socket.sendall(struct.pack("!BB4x", 0x81, 0x80 | len(text)) + text)

    def __enter__(self) -> "_Frozen":
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()
