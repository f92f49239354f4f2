"""Actions. No independent package speaks them, so each end of TRADE is tried with the keys and bytes that published
facts give (raw zenoh), and then both with each other.
"""

import struct
import threading
import time
from collections.abc import Iterator

import pytest
import zenoh

from tests.support.ros2_processes import until_served
from tests.support.waiting import wait_until
from tests.unit.ros.ros2.fibonacci_action import (
    ATTACHMENT,
    CDR,
    FIBONACCI,
    ID,
    LONG_S,
    OTHER,
    Doing,
    ask,
    key,
    numbers,
    pursue,
)
from trade.errors import ConfigurationError
from trade_gateway.ros._graph import Goal, GoalEnd, Outcome, RosUnreachable
from trade_gateway.ros.ros2 import Ros2
from trade_gateway.ros.ros2._names import TokenKind

pytestmark = pytest.mark.realtime


def test_a_goal_is_sent_heard_of_and_answered_in_the_bytes_of_ros(graph: Ros2, raw: zenoh.Session) -> None:
    doing, feedback = Doing(), []
    graph.act("/fib1", FIBONACCI, doing)
    with raw.declare_subscriber(key("fib1", "feedback"), lambda it: feedback.append(it.payload.to_bytes())):
        accepted = ask(raw, "fib1", "send_goal", ID + struct.pack("<i", 5))
        assert accepted[0] == 1
        assert struct.unpack("<xxxxiI", accepted)[0] > 1_700_000_000
        wait_until(lambda: feedback, "feedback has come")
        assert feedback[0] == CDR + ID + numbers(0, 1)
        doing.go_on.set()
        assert ask(raw, "fib1", "get_result", ID) == b"\4\0\0\0" + numbers(5)
    assert doing.goals[0].message == {"order": 5}


def test_a_goal_that_is_refused_is_not_accepted_and_the_one_before_it_is_not_canceled(
    graph: Ros2, raw: zenoh.Session
) -> None:
    doing = Doing()

    def refuse(message: dict[str, int]) -> Outcome | None:
        return Outcome(GoalEnd.ABORTED, {}, "too many") if message["order"] > 9 else None

    graph.act("/fib11", FIBONACCI, doing, refuse)
    assert ask(raw, "fib11", "send_goal", ID + struct.pack("<i", 5))[0] == 1
    assert ask(raw, "fib11", "send_goal", OTHER + struct.pack("<i", 10))[0] == 0
    doing.go_on.set()
    assert ask(raw, "fib11", "get_result", ID) == b"\4\0\0\0" + numbers(5)
    assert [goal.message for goal in doing.goals] == [{"order": 5}]


def test_a_client_may_ask_for_the_result_before_there_is_one(graph: Ros2, raw: zenoh.Session) -> None:
    doing = Doing()
    graph.act("/fib2", FIBONACCI, doing)
    ask(raw, "fib2", "send_goal", ID + struct.pack("<i", 8))
    until_served(raw, key("fib2", "get_result"))
    replies = raw.get(key("fib2", "get_result"), payload=CDR + ID, attachment=ATTACHMENT, timeout=LONG_S)
    doing.go_on.set()
    (reply,) = list(replies)
    assert reply.ok is not None
    assert reply.ok.payload.to_bytes() == CDR + b"\4\0\0\0" + numbers(8)


def test_a_goal_is_canceled_by_its_id(graph: Ros2, raw: zenoh.Session) -> None:
    doing = Doing()
    graph.act("/fib3", FIBONACCI, doing)
    ask(raw, "fib3", "send_goal", ID + struct.pack("<i", 1))
    wait_until(lambda: doing.goals, "it has begun")
    answer = ask(raw, "fib3", "cancel_goal", ID + bytes(8))
    assert answer[0] == 0
    assert answer[4:24] == b"\1\0\0\0" + ID
    assert ask(raw, "fib3", "get_result", ID) == b"\5\0\0\0" + numbers(1)
    assert ask(raw, "fib3", "cancel_goal", ID + bytes(8)) == b"\3\0\0\0" + bytes(4)  # it has ended
    assert ask(raw, "fib3", "cancel_goal", OTHER + bytes(8)) == b"\2\0\0\0" + bytes(4)  # not known


@pytest.fixture
def introduced(graph: Ros2, monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Event]:
    """Who sends our graph something is a stranger whose token comes when the test sets this."""
    comes = threading.Event()
    monkeypatch.setattr(graph._node.presence, "known", lambda _gid: "")
    monkeypatch.setattr(graph._node.presence, "node_of", lambda _gid: comes.wait(LONG_S) and "/late")
    yield comes
    comes.set()


@pytest.mark.parametrize("which", [ID + bytes(8), bytes(24)], ids=["it", "all"])
def test_S01_a_goal_that_is_canceled_while_its_sender_is_waited_for_is_not_begun(
    graph: Ros2, raw: zenoh.Session, introduced: threading.Event, which: bytes
) -> None:
    doing = Doing()
    graph.act("/fib9", FIBONACCI, doing)
    assert ask(raw, "fib9", "send_goal", ID + struct.pack("<i", 1))[0] == 1
    assert ask(raw, "fib9", "cancel_goal", which)[:24] == b"\0\0\0\0\1\0\0\0" + ID
    introduced.set()
    assert ask(raw, "fib9", "get_result", ID) == b"\5\0\0\0" + numbers()
    assert not doing.goals


def test_S01_a_goal_begins_with_its_sender_known(graph: Ros2, raw: zenoh.Session, introduced: threading.Event) -> None:
    doing = Doing()
    action = graph.act("/fib10", FIBONACCI, doing)
    began_at = time.monotonic()
    assert ask(raw, "fib10", "send_goal", ID + struct.pack("<i", 1))[0] == 1
    answered_at = time.monotonic()
    introduced.set()
    wait_until(lambda: doing.goals, "it has begun")
    assert doing.goals[0].client == "/late"
    assert began_at <= doing.goals[0].came_at <= answered_at
    action.close()


@pytest.mark.parametrize(("second", "ends"), [(2**31 - 1, True), (1, False)])
def test_goals_are_canceled_by_a_time(graph: Ros2, raw: zenoh.Session, second: int, ends: bool) -> None:
    doing = Doing()
    action = graph.act("/fib4", FIBONACCI, doing)
    ask(raw, "fib4", "send_goal", ID + struct.pack("<i", 1))
    answer = ask(raw, "fib4", "cancel_goal", bytes(16) + struct.pack("<iI", second, 0))
    assert answer[:8] == b"\0\0\0\0" + bytes([ends, 0, 0, 0])
    doing.go_on.set()
    action.close()


def test_all_goals_are_canceled_by_neither(graph: Ros2, raw: zenoh.Session) -> None:
    graph.act("/fib5", FIBONACCI, Doing())
    ask(raw, "fib5", "send_goal", ID + struct.pack("<i", 1))
    assert ask(raw, "fib5", "cancel_goal", bytes(24))[:8] == b"\0\0\0\0\1\0\0\0"
    assert ask(raw, "fib5", "get_result", ID)[0] == 5


def test_the_same_goal_is_accepted_once(graph: Ros2, raw: zenoh.Session) -> None:
    doing = Doing()
    graph.act("/fib6", FIBONACCI, doing)
    assert ask(raw, "fib6", "send_goal", ID + struct.pack("<i", 1))[0] == 1
    assert ask(raw, "fib6", "send_goal", ID + struct.pack("<i", 1))[0] == 0
    wait_until(lambda: doing.goals, "it has begun")
    assert len(doing.goals) == 1


def test_the_result_of_a_goal_that_is_not_known_is_answered_as_such(graph: Ros2, raw: zenoh.Session) -> None:
    graph.act("/fib7", FIBONACCI, Doing())
    assert ask(raw, "fib7", "get_result", OTHER) == b"\0\0\0\0" + numbers()


def test_the_status_of_goals_is_published(graph: Ros2, raw: zenoh.Session) -> None:
    doing, reported = Doing(), []
    with raw.declare_subscriber(key("fib8", "status"), lambda it: reported.append(it.payload.to_bytes())):
        graph.act("/fib8", FIBONACCI, doing)
        wait_until(
            lambda: list(raw.liveliness().get("@ros2_lv/0/*/*/*/MP/**/%fib8%_action%status/**")), "it is published"
        )
        ask(raw, "fib8", "send_goal", ID + struct.pack("<i", 1))
        doing.go_on.set()
        wait_until(lambda: reported and reported[-1][32] == 4, "its success is published")
    assert reported[-1][:24] == CDR + b"\1\0\0\0" + ID
    assert {each[32] for each in reported} <= {1, 2, 4}


def test_a_goal_is_pursued_to_its_end(graph: Ros2, other: Ros2) -> None:
    doing, feedback = Doing(), []
    graph.act("/fib", FIBONACCI, doing)
    pursuit = pursue(other, "fib", 6, feedback.append)
    wait_until(lambda: feedback, "feedback is delivered")
    doing.go_on.set()
    assert pursuit.wait(LONG_S) == Outcome(GoalEnd.SUCCEEDED, {"sequence": [6]})
    assert doing.goals[0].client == "/client"
    assert feedback == [{"sequence": [0, 1]}]


def test_a_later_goal_cancels_the_one_before(graph: Ros2, other: Ros2) -> None:
    doing = Doing()
    graph.act("/one_at_a_time", FIBONACCI, doing)
    first = pursue(other, "one_at_a_time", 1)
    wait_until(lambda: doing.goals, "the first has begun")
    second = pursue(other, "one_at_a_time", 2)
    assert first.wait(LONG_S) == Outcome(GoalEnd.CANCELED, {"sequence": [1]})
    doing.go_on.set()
    assert second.wait(LONG_S) == Outcome(GoalEnd.SUCCEEDED, {"sequence": [2]})


def test_a_goal_that_fails_is_aborted(graph: Ros2, other: Ros2, caplog: pytest.LogCaptureFixture) -> None:
    def fail(_goal: Goal) -> Outcome:
        raise ValueError("no")

    graph.act("/failing", FIBONACCI, fail)
    assert pursue(other, "failing", 1).wait(LONG_S) == Outcome(GoalEnd.ABORTED, {"sequence": []})


def test_a_result_that_does_not_fit_aborts_the_goal(graph: Ros2, other: Ros2, caplog: pytest.LogCaptureFixture) -> None:
    graph.act("/misfit", FIBONACCI, lambda goal: Outcome(GoalEnd.SUCCEEDED, {"no such field": 1}))
    assert pursue(other, "misfit", 1).wait(LONG_S).how is GoalEnd.ABORTED


def test_a_closed_action_cancels_its_goals_and_reports_their_end(graph: Ros2, other: Ros2) -> None:
    doing = Doing()
    action = graph.act("/closing", FIBONACCI, doing)
    pursuit = pursue(other, "closing", 1)
    wait_until(lambda: doing.goals and doing.goals[0].waiting, "its client has asked for the result")
    action.close()
    action.close()
    assert pursuit.wait(LONG_S).how is GoalEnd.CANCELED
    served = "/closing/_action/send_goal"
    wait_until(lambda: not other._node.presence.offered(TokenKind.SERVER, served), "the end of the action is seen")
    with pytest.raises(RosUnreachable, match="no node serves it"):
        other.pursue("/closing", FIBONACCI, {"order": 1})


def test_a_server_that_is_gone_is_noticed(graph: Ros2, other: Ros2, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trade_gateway.ros.ros2._pursuit._GONE_S", 0.1)
    monkeypatch.setattr("trade_gateway.ros.ros2._pursuit._ABANDON_S", 0.1)
    doing = Doing()
    graph.act("/gone", FIBONACCI, doing)
    pursuit = pursue(other, "gone", 1)
    graph._link.close()  # as if it were killed: nothing is sent any more
    with pytest.raises(RosUnreachable, match="its server is gone"):
        pursuit.wait(LONG_S)
    doing.go_on.set()


def test_an_action_without_a_server_is_unreachable(graph: Ros2) -> None:
    with pytest.raises(RosUnreachable, match="no node serves it"):
        graph.pursue("/missing", FIBONACCI, {"order": 1})


def test_a_goal_that_does_not_fit_is_not_sent(graph: Ros2) -> None:
    with pytest.raises(ConfigurationError, match="has no speed; it has order"):
        graph.pursue("/missing", FIBONACCI, {"speed": 1})


def test_a_service_is_no_action(graph: Ros2) -> None:
    with pytest.raises(ConfigurationError, match="is not an action"):
        graph.act("/wrong", "example_interfaces/srv/AddTwoInts", Doing())
