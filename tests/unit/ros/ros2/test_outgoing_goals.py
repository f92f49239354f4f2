"""Goals that we send: our client of actions, and a server of keys and bytes (see test_goals.py)."""

import struct
from collections.abc import Callable
from typing import Any

import pytest
import zenoh

from tests.support.ros2_processes import Router, raw_session
from tests.support.waiting import wait_until
from tests.unit.ros.ros2.fibonacci_action import ATTACHMENT, CDR, LONG_S, OTHER, key, numbers, pursue
from trade_gateway.ros._graph import GoalEnd, Outcome, RosRefused, RosUnreachable
from trade_gateway.ros.ros2 import Ros2

pytestmark = pytest.mark.realtime


class RawServer:
    """A server of an action; its answers are set by the test."""

    def __init__(self, session: zenoh.Session, action: str, accepts: bool, result: bytes | None) -> None:
        self.asked: list[tuple[str, bytes]] = []
        self._held: list[zenoh.Query] = []
        self._session = session
        self.action = action
        self._answers: dict[str, bytes | None] = {
            "send_goal": bytes([accepts]) + bytes(11),
            "cancel_goal": bytes(8),
            "get_result": result,
        }
        self._declared = [
            session.declare_queryable(key(action, part), self._answer, complete=True) for part in self._answers
        ]

    def _answer(self, query: zenoh.Query) -> None:
        part = str(query.key_expr).split("/")[3]
        assert query.payload is not None
        self.asked.append((part, query.payload.to_bytes()))
        answer = self._answers[part]
        if answer is None:
            self._held.append(query)
            return
        if not answer:  # as if it had died of the question
            query.drop()
            return
        if part == "send_goal":
            goal_id = query.payload.to_bytes()[4:20]
            for each in (OTHER, goal_id):
                self._session.put(key(self.action, "feedback"), CDR + each + numbers(each[0]), attachment=ATTACHMENT)
        query.reply(str(query.key_expr), CDR + answer, attachment=ATTACHMENT)
        query.drop()

    def end(self, status: int) -> None:
        """Answer who asks for the result, from now on."""
        self._answers["get_result"] = bytes([status, 0, 0, 0]) + numbers()
        for query in self._held:
            if "get_result" in str(query.key_expr):
                query.reply(str(query.key_expr), CDR + self._answers["get_result"], attachment=ATTACHMENT)
            query.drop()

    def of(self, part: str) -> list[bytes]:
        return [payload for asked, payload in self.asked if asked == part]


@pytest.mark.parametrize(
    ("status", "how"), [(4, GoalEnd.SUCCEEDED), (5, GoalEnd.CANCELED), (6, GoalEnd.ABORTED)], ids=str
)
def test_the_action_client_uses_the_ros_wire_format(graph: Ros2, raw: zenoh.Session, status: int, how: GoalEnd) -> None:
    server = RawServer(raw, "theirs", accepts=True, result=bytes([status, 0, 0, 0]) + numbers(1, 2, 3))
    feedback: list[Any] = []
    outcome = pursue(graph, "theirs", 3, feedback.append).wait(LONG_S)
    assert outcome == Outcome(how, {"sequence": [1, 2, 3]})
    (sent,) = server.of("send_goal")
    assert (sent[:4], sent[20:]) == (CDR, struct.pack("<i", 3))
    assert server.of("get_result")[0] == sent[:20]
    assert [each["sequence"] for each in feedback] in ([], [[sent[4]]])  # never of another goal


def test_the_action_client_receives_feedback(graph: Ros2, raw: zenoh.Session) -> None:
    server = RawServer(raw, "reporting", accepts=True, result=None)
    feedback: list[Any] = []
    pursuit = pursue(graph, "reporting", 3, feedback.append)
    wait_until(lambda: feedback, "feedback is delivered")
    assert feedback == [{"sequence": [server.of("send_goal")[0][4]]}]
    with pytest.raises(RosUnreachable, match=r"has not ended within 0\.1 s"):
        pursuit.wait(0.1)


def test_a_rejected_goal_is_refused_when_it_is_waited_for(graph: Ros2, raw: zenoh.Session) -> None:
    server = RawServer(raw, "rejecting", accepts=False, result=None)
    pursuit = pursue(graph, "rejecting", 3)
    with pytest.raises(RosRefused, match="rejected"):
        pursuit.wait(LONG_S)
    assert not server.of("get_result")


def test_cancel_sends_the_goal_id_to_the_action_server(graph: Ros2, raw: zenoh.Session) -> None:
    server = RawServer(raw, "canceling", accepts=True, result=None)
    pursue(graph, "canceling", 3).cancel()
    wait_until(lambda: server.of("cancel_goal"), "it is asked to")
    assert server.of("cancel_goal")[0] == server.of("send_goal")[0][:20] + bytes(8)


def test_S07_a_goal_that_is_canceled_without_a_router_is_canceled_when_there_is_one(
    own_router: Router, open_graph: Callable[..., Ros2], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trade_gateway.ros.ros2._pursuit._GONE_S", 1000.0)
    own_router.start()
    graph = open_graph(own_router)
    with raw_session(own_router) as raw:
        server = RawServer(raw, "cut_off", accepts=True, result=None)
        pursuit = pursue(graph, "cut_off", 3)
        own_router.kill()
        wait_until(lambda: graph.healthy, "the loss is noticed")
        pursuit.cancel()
        own_router.start()
        wait_until(lambda: server.of("cancel_goal"), "it gets a cancel request")
        assert server.of("cancel_goal")[0] == server.of("send_goal")[0][:20] + bytes(8)


def test_S05_closing_the_graph_cancels_its_pending_goals(graph: Ros2, raw: zenoh.Session) -> None:
    server = RawServer(raw, "orphaned", accepts=True, result=None)
    pursuit = pursue(graph, "orphaned", 3)
    graph.close()
    assert server.of("cancel_goal") == [server.of("send_goal")[0][:20] + bytes(8)]
    with pytest.raises(RosUnreachable, match="the goal was canceled"):
        pursuit.wait(LONG_S)


def test_S05_a_goal_whose_acceptance_is_not_heard_of_is_canceled(
    graph: Ros2, raw: zenoh.Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trade_gateway.ros.ros2._pursuit._ACCEPT_S", 0.1)
    monkeypatch.setattr("trade_gateway.ros.ros2._pursuit._ABANDON_S", LONG_S)
    server = RawServer(raw, "deaf", accepts=True, result=None)
    server._answers["send_goal"] = None
    pursuit = pursue(graph, "deaf", 3)
    wait_until(lambda: server.of("get_result"), "it gets a cancel request, and one for the result")
    assert server.of("cancel_goal")[0] == server.of("send_goal")[0][:20] + bytes(8)
    assert server.of("get_result")[0] == server.of("send_goal")[0][:20]
    with pytest.raises(RosUnreachable, match=r"has not ended within 0\.1 s"):
        pursuit.wait(0.1)  # the arm may still move
    server.end(5)
    with pytest.raises(RosUnreachable, match="what was asked is unknown; it was canceled, and has ended"):
        pursuit.wait(LONG_S)


def test_S05_a_goal_that_may_have_begun_can_be_canceled_by_who_sent_it_too(
    graph: Ros2, raw: zenoh.Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trade_gateway.ros.ros2._pursuit._ACCEPT_S", 0.1)
    monkeypatch.setattr("trade_gateway.ros.ros2._pursuit._AGAIN_S", 1000.0)  # once by itself
    server = RawServer(raw, "mute", accepts=True, result=None)
    server._answers |= {"send_goal": None, "cancel_goal": b"\2" + bytes(7)}  # it does not know the goal yet
    pursuit = pursue(graph, "mute", 3)
    wait_until(lambda: len(server.of("cancel_goal")) == 1, "it gets a cancel request")
    pursuit.cancel()
    wait_until(lambda: len(server.of("cancel_goal")) == 2, "it gets another cancel request")


@pytest.mark.parametrize(
    ("name", "answers", "end"),
    [
        ("unheard", {"send_goal": None}, "it was canceled, but whether it has ended is unknown"),
        (
            "unknown",
            {"send_goal": None, "cancel_goal": b"\2" + bytes(7)},
            "it could not be canceled, and whether it has ended is unknown",
        ),
        ("ended", {"send_goal": None, "cancel_goal": b"\3" + bytes(7)}, "it was canceled, and has ended"),
        ("dropped", {"send_goal": b""}, "it was canceled, but whether it has ended is unknown"),
    ],
    ids=["unheard", "unknown_there", "ended_there", "server_ended"],
)
def test_S05_of_a_goal_whose_end_is_not_heard_of_it_is_said_what_is_known(
    graph: Ros2,
    raw: zenoh.Session,
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    answers: dict[str, bytes | None],
    end: str,
) -> None:
    monkeypatch.setattr("trade_gateway.ros.ros2._pursuit._ACCEPT_S", 0.5)
    monkeypatch.setattr("trade_gateway.ros.ros2._pursuit._ABANDON_S", 3.0)
    server = RawServer(raw, name, accepts=True, result=None)
    server._answers |= answers
    pursuit = pursue(graph, server.action, 3)
    with pytest.raises(RosUnreachable, match=end):
        pursuit.wait(LONG_S)
    assert server.of("send_goal")
    assert server.of("cancel_goal")[0] == server.of("send_goal")[0][:20] + bytes(8)


def test_a_server_that_does_not_know_the_goal_any_more_is_no_end_of_it(graph: Ros2, raw: zenoh.Session) -> None:
    RawServer(raw, "forgetful", accepts=True, result=bytes(4) + numbers())
    with pytest.raises(RosUnreachable, match="does not know the goal any more"):
        pursue(graph, "forgetful", 3).wait(LONG_S)
