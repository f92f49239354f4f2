"""Services, with clients and servers of zenoh-ros2-sdk at the other end."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from tests.support.ros2_processes import Process, Router, until_offered
from tests.support.waiting import wait_until
from trade_gateway.ros._graph import RosRefused, RosUnreachable
from trade_gateway.ros.ros2 import Ros2
from trade_gateway.ros.ros2._names import TokenKind
from trade_gateway.ros.ros2._services import Client

pytestmark = pytest.mark.realtime

ADD = "example_interfaces/srv/AddTwoInts"
LONG_S = 60.0


def call(graph: Ros2, name: str, request: dict[str, Any], timeout_s: float = LONG_S, type_name: str = ADD) -> Any:
    """Call a service that is present."""
    until_offered(graph, name, type_name)
    return graph.call(name, type_name, request, timeout_s)


def add(request: dict[str, Any], _who: str, _came_at: float) -> dict[str, Any]:
    return {"sum": request["a"] + request["b"]}


@contextmanager
def calling(graph: Ros2, name: str, times: int) -> Iterator[None]:
    """Calls under way; all have been answered afterwards."""
    until_offered(graph, name, ADD)
    answered: list[Any] = []
    callers = [
        threading.Thread(target=lambda: answered.append(graph.call(name, ADD, {}, LONG_S))) for _ in range(times)
    ]
    for caller in callers:
        caller.start()
    yield
    for caller in callers:
        caller.join(LONG_S)
    assert answered == [{"sum": 0}] * times


def test_a_peer_node_calls_a_service_of_the_graph(graph: Ros2, peer: Process) -> None:
    graph.serve("/add_ours", ADD, add)
    peer.ask("add", service="/add_ours", a=2, b=-3)
    assert peer.hear("added")["sum"] == -1


def test_we_call_a_service_of_another_node(graph: Ros2, peer: Process) -> None:
    peer.ask("serve", service="/add_theirs")
    peer.hear("serving", service="/add_theirs")
    assert call(graph, "/add_theirs", {"a": 40, "b": 2}) == {"sum": 42}
    assert peer.has("asked", a=40, b=2)


def test_a_service_receives_the_name_of_the_calling_node(
    graph: Ros2, router: Router, open_graph: Callable[..., Ros2]
) -> None:
    asked: list[str] = []
    graph.serve("/who", ADD, lambda _, who, _at: asked.append(who) or {})
    assert call(open_graph(router, node="/arm/asks"), "/who", {}) == {"sum": 0}
    assert asked == ["/arm/asks"]


def test_what_another_node_fails_with_is_a_refusal(graph: Ros2, peer: Process) -> None:
    peer.ask("serve", service="/fails", fails=True)
    peer.hear("serving", service="/fails")
    with pytest.raises(RosRefused, match="no sums today"):
        call(graph, "/fails", {})


def test_an_exception_in_a_service_is_reported_to_the_caller(
    graph: Ros2, router: Router, open_graph: Callable[..., Ros2], caplog: pytest.LogCaptureFixture
) -> None:
    def fail(_request: dict[str, Any], _who: str, _came_at: float) -> dict[str, Any]:
        raise ValueError("the arm is locked")

    graph.serve("/refuses", ADD, fail)
    with pytest.raises(RosRefused, match="ValueError: the arm is locked"):
        call(open_graph(router, node="/asks"), "/refuses", {})


def test_a_call_to_a_service_without_a_server_fails_immediately(graph: Ros2) -> None:
    with pytest.raises(RosUnreachable, match="no node serves it"):
        graph.call("/missing", ADD, {}, LONG_S)


def test_a_service_of_another_type_is_not_that_service(graph: Ros2, peer: Process) -> None:
    peer.ask("serve", service="/other_type")
    peer.hear("serving", service="/other_type")
    with pytest.raises(RosUnreachable, match="no node serves it as std_srvs/srv/Trigger"):
        graph.call("/other_type", "std_srvs/srv/Trigger", {}, LONG_S)


def test_a_server_that_does_not_answer_is_not_waited_for_longer_than_asked(graph: Ros2, peer: Process) -> None:
    peer.ask("serve", service="/silent", hangs=True)
    peer.hear("serving", service="/silent")
    with pytest.raises(RosUnreachable, match=r"within 0\.2 s; whether it did what was asked is unknown"):
        call(graph, "/silent", {}, 0.2)


def test_a_server_that_is_killed_while_it_is_asked_is_noticed(
    graph: Ros2, router: Router, start_peer: Callable[..., Process]
) -> None:
    doomed = start_peer(router, "doomed")
    doomed.ask("serve", service="/doomed", hangs=True)
    doomed.hear("serving", service="/doomed")
    failed: list[str] = []

    def ask() -> None:
        try:
            call(graph, "/doomed", {})
        except RosUnreachable as unreachable:
            failed.append(str(unreachable))

    calling = threading.Thread(target=ask)
    calling.start()
    doomed.hear("asked")
    doomed.kill()
    calling.join(LONG_S / 2)
    assert not calling.is_alive()
    assert "no node serves it" in failed[0]


def test_of_two_servers_of_one_name_one_is_asked(graph: Ros2, router: Router, open_graph: Callable[..., Ros2]) -> None:
    """ROS 2 would ask both: what they do would be done twice."""
    asked: list[str] = []
    for number, node in enumerate(("/left", "/right")):
        server = open_graph(router, node=node)
        server.serve("/twice", ADD, lambda _, who, _at, number=number: asked.append(who) or {"sum": number})
    both = open_graph(router, node="/watches")
    until_offered(graph, "/twice", ADD)
    wait_until(lambda: both._node.presence._offered[TokenKind.SERVER, "/twice"] == 2, "both are there")
    for _ in range(5):
        call(graph, "/twice", {})
    assert len(asked) == 5


def test_a_closed_service_is_offered_no_more(graph: Ros2, router: Router, open_graph: Callable[..., Ros2]) -> None:
    caller = open_graph(router, node="/asks")
    service = graph.serve("/short", ADD, add)
    assert call(caller, "/short", {"a": 1}) == {"sum": 1}
    service.close()
    service.close()
    with pytest.raises(RosUnreachable):
        caller.call("/short", ADD, {}, LONG_S)


def test_a_request_without_fields_and_an_empty_answer_pass(
    graph: Ros2, router: Router, open_graph: Callable[..., Ros2]
) -> None:
    graph.serve("/reset", "std_srvs/srv/Empty", lambda _request, _who, _at: {})
    assert call(open_graph(router, node="/asks"), "/reset", {}, type_name="std_srvs/srv/Empty") == {}


def test_another_node_that_asks_for_our_parameters_is_answered(graph: Ros2, peer: Process) -> None:
    peer.ask("parameter_types", node="/trade", names=["use_sim_time", "other"])
    assert peer.hear("types")["types"] == [0, 0]


@pytest.mark.parametrize("kept_s", [1000.0, 0.0], ids=["asked_unseen", "asked_seen"])
def test_S05_a_queued_request_keeps_the_name_of_a_node_that_died_meanwhile(
    graph: Ros2, router: Router, open_graph: Callable[..., Ros2], monkeypatch: pytest.MonkeyPatch, kept_s: float
) -> None:
    """It is known by when it came; and if its token came only after it, by what is kept of those that ended."""
    monkeypatch.setattr("trade_gateway.ros.ros2._presence._ENDED_S", kept_s)
    asked: list[str] = []
    busy, go_on = threading.Event(), threading.Event()

    def answer(_request: dict[str, Any], who: str, _came_at: float) -> dict[str, Any]:
        asked.append(who)
        busy.set()
        assert go_on.wait(LONG_S)
        return {}

    server = graph.serve("/last_words", ADD, answer)
    presence = graph._node.presence
    first, doomed = open_graph(router, node="/first"), open_graph(router, node="/doomed")
    with calling(first, "/last_words", 1):
        assert busy.wait(LONG_S)
        until_offered(doomed, "/last_words", ADD)
        client = Client(doomed._node, "/last_words", ADD)
        wait_until(lambda: presence.known(client._endpoint.gid), "it is seen")
        if kept_s:  # its token has not come yet
            monkeypatch.setattr(presence, "known", lambda _gid: "")
        client.send({}, LONG_S)
        wait_until(lambda: server._mailbox._waiting, "its request waits")
        monkeypatch.undo()
        monkeypatch.setattr("trade_gateway.ros.ros2._presence._ENDED_S", kept_s)
        doomed.close()
        wait_until(lambda: client._endpoint.gid not in presence._node_of, "its end is seen")
        go_on.set()
    wait_until(lambda: len(asked) == 2, "its request has its turn")
    assert asked == ["/first", "/doomed"]


def test_S01_a_service_receives_the_arrival_time_of_a_queued_request(
    graph: Ros2, router: Router, open_graph: Callable[..., Ros2]
) -> None:
    came: list[float] = []
    busy, go_on = threading.Event(), threading.Event()

    def answer(_request: dict[str, Any], _who: str, came_at: float) -> dict[str, Any]:
        came.append(came_at)
        busy.set()
        assert go_on.wait(LONG_S)
        return {}

    server = graph.serve("/when", ADD, answer)
    caller = open_graph(router, node="/asks")
    began_at = time.monotonic()
    with calling(caller, "/when", 2):
        assert busy.wait(LONG_S)
        wait_until(lambda: server._mailbox._waiting, "the second waits")
        second_waits_at = time.monotonic()
        go_on.set()
    first_at, second_at = came
    assert began_at <= first_at <= second_at <= second_waits_at


def test_S07_a_stop_waits_neither_for_a_hanging_stop_nor_for_the_name_of_its_caller(
    graph: Ros2, router: Router, open_graph: Callable[..., Ros2], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trade_gateway.ros.ros2._presence._INTRODUCTION_S", 1000.0)
    monkeypatch.setattr("trade_gateway.ros.ros2._services._LATE_S", -1.0)  # not even its age counts
    presence = graph._node.presence
    monkeypatch.setattr(presence, "known", lambda _gid: "")
    presence._waits_from = 0.0
    asked: list[str] = []
    both = threading.Barrier(2)

    def answer(_request: dict[str, Any], who: str, _came_at: float) -> dict[str, Any]:
        both.wait(LONG_S)
        asked.append(who)
        return {}

    graph.serve("/halt", ADD, answer, stops=True)
    with calling(open_graph(router, node="/asks"), "/halt", 2):
        pass
    assert asked == ["", ""]
