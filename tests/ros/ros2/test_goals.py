"""Actions. No package of another hand speaks them, so each end of ours is tried with the keys and bytes that published
facts give (raw zenoh), and then both with each other.

Keys have the type hashes that ``rosidl`` made for ``example_interfaces/action/Fibonacci``.
"""

import struct
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import zenoh

from ros2_peers import Router, raw_session, until_served
from trade.errors import ConfigurationError
from trade_gateway.ros._graph import Ended, Goal, Outcome, Pursuit, RosRefused, RosUnreachable
from trade_gateway.ros.ros2 import Ros2
from trade_gateway.ros.ros2._names import Kind
from waiting import wait_until

FIBONACCI = "example_interfaces/action/Fibonacci"
LONG_S = 60.0
CDR = b"\0\1\0\0"
ID = bytes(range(1, 17))
OTHER = bytes(range(17, 33))
_PARTS = {
    "send_goal": (
        "example_interfaces::action::dds_::Fibonacci_SendGoal_",
        "RIHS01_d1a57fb2a4afe8c21e34fb10db206f16ce6729b28531141472df92277c55b557",
    ),
    "get_result": (
        "example_interfaces::action::dds_::Fibonacci_GetResult_",
        "RIHS01_1b0de0d5d29dc955d92f546706568428632771db13ec84c15ec1c1a59f424a57",
    ),
    "cancel_goal": (
        "action_msgs::srv::dds_::CancelGoal_",
        "RIHS01_573d8b0a534451d7bc2ac8c5ffde8ac14b8593b7001175d0cd6516dcbeb8689a",
    ),
    "feedback": (
        "example_interfaces::action::dds_::Fibonacci_FeedbackMessage_",
        "RIHS01_c1de71afd52e49a89c53d8262366884185bc0a02f78ce051c4e46b0a7fe59bb2",
    ),
    "status": (
        "action_msgs::msg::dds_::GoalStatusArray_",
        "RIHS01_6c1684b00f177d37438febe6e709fc4e2b0d4248dca4854946f9ed8b30cda83e",
    ),
}
ATTACHMENT = struct.pack("<qqB16s", 1, 1, 16, b"\xab" * 16)


def key(action: str, part: str) -> str:
    type_name, type_hash = _PARTS[part]
    return f"0/{action}/_action/{part}/{type_name}/{type_hash}"


def numbers(*values: int) -> bytes:
    return struct.pack(f"<I{len(values)}i", len(values), *values)


@pytest.fixture
def raw(router: Router) -> Iterator[zenoh.Session]:
    with raw_session(router) as session:
        yield session


@pytest.fixture
def other(router: Router, open_graph: Callable[..., Ros2]) -> Ros2:
    """Ours, once more."""
    return open_graph(router, node="/client")


def ask(session: zenoh.Session, action: str, part: str, payload: bytes) -> bytes:
    until_served(session, key(action, part))
    replies = session.get(key(action, part), payload=CDR + payload, attachment=ATTACHMENT, timeout=LONG_S)
    (reply,) = list(replies)
    assert reply.ok is not None
    answer = reply.ok.payload.to_bytes()
    assert answer[:4] == CDR
    assert reply.ok.attachment is not None
    sequence, _, length, gid = struct.unpack("<qqB16s", reply.ok.attachment.to_bytes())
    assert (sequence, length, gid) == (1, 16, b"\xab" * 16)
    return answer[4:]


def pursue(graph: Ros2, action: str, order: int, feedback: Callable[[Any], object] | None = None) -> Pursuit:
    for part in ("send_goal", "cancel_goal", "get_result"):
        until_served(graph._link.session, key(action, part))
    return graph.pursue(f"/{action}", FIBONACCI, {"order": order}, feedback)


class Doing:
    """Goals that go on until the test says so, or somebody cancels them."""

    def __init__(self) -> None:
        self.goals: list[Any] = []
        self.go_on = threading.Event()

    def __call__(self, goal: Goal) -> Outcome:
        ended = threading.Event()
        canceled = threading.Event()
        goal.when_canceled(lambda: (canceled.set(), ended.set()))
        self.goals.append(goal)
        goal.feedback({"sequence": [0, 1]})
        while not ended.is_set() and not self.go_on.wait(0.02):
            pass
        sequence = [goal.message["order"]]
        return Outcome(Ended.CANCELED if canceled.is_set() else Ended.SUCCEEDED, {"sequence": sequence})


# --- our server, and a client of keys and bytes


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
    doing, told = Doing(), []
    with raw.declare_subscriber(key("fib8", "status"), lambda it: told.append(it.payload.to_bytes())):
        graph.act("/fib8", FIBONACCI, doing)
        wait_until(lambda: list(raw.liveliness().get("@ros2_lv/0/*/*/*/MP/**/%fib8%_action%status/**")), "it is there")
        ask(raw, "fib8", "send_goal", ID + struct.pack("<i", 1))
        doing.go_on.set()
        wait_until(lambda: told and told[-1][32] == 4, "it is told that it has succeeded")
    assert told[-1][:24] == CDR + b"\1\0\0\0" + ID
    assert {each[32] for each in told} <= {1, 2, 4}


# --- our client, and a server of keys and bytes


class RawServer:
    """Of an action; answers as it is told to."""

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


@pytest.mark.parametrize(("status", "how"), [(4, Ended.SUCCEEDED), (5, Ended.CANCELED), (6, Ended.ABORTED)], ids=str)
def test_a_goal_of_ours_is_pursued_in_the_bytes_of_ros(
    graph: Ros2, raw: zenoh.Session, status: int, how: Ended
) -> None:
    server = RawServer(raw, "theirs", accepts=True, result=bytes([status, 0, 0, 0]) + numbers(1, 2, 3))
    feedback: list[Any] = []
    outcome = pursue(graph, "theirs", 3, feedback.append).wait(LONG_S)
    assert outcome == Outcome(how, {"sequence": [1, 2, 3]})
    (sent,) = server.of("send_goal")
    assert (sent[:4], sent[20:]) == (CDR, struct.pack("<i", 3))
    assert server.of("get_result")[0] == sent[:20]
    assert [each["sequence"] for each in feedback] in ([], [[sent[4]]])  # never of another goal


def test_feedback_of_a_goal_of_ours_is_told(graph: Ros2, raw: zenoh.Session) -> None:
    server = RawServer(raw, "telling", accepts=True, result=None)
    feedback: list[Any] = []
    pursuit = pursue(graph, "telling", 3, feedback.append)
    wait_until(lambda: feedback, "feedback is told")
    assert feedback == [{"sequence": [server.of("send_goal")[0][4]]}]
    with pytest.raises(RosUnreachable, match=r"has not ended within 0\.1 s"):
        pursuit.wait(0.1)


def test_a_rejected_goal_is_refused_when_it_is_waited_for(graph: Ros2, raw: zenoh.Session) -> None:
    server = RawServer(raw, "rejecting", accepts=False, result=None)
    pursuit = pursue(graph, "rejecting", 3)
    with pytest.raises(RosRefused, match="rejected"):
        pursuit.wait(LONG_S)
    assert not server.of("get_result")


def test_a_goal_of_ours_is_canceled_by_its_id(graph: Ros2, raw: zenoh.Session) -> None:
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
        wait_until(lambda: server.of("cancel_goal"), "it is told to cancel it")
        assert server.of("cancel_goal")[0] == server.of("send_goal")[0][:20] + bytes(8)


def test_S05_goals_of_ours_are_canceled_when_our_graph_ends(graph: Ros2, raw: zenoh.Session) -> None:
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
    wait_until(lambda: server.of("get_result"), "it is told to cancel it, and asked for its end")
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
    wait_until(lambda: len(server.of("cancel_goal")) == 1, "it is told to cancel it")
    pursuit.cancel()
    wait_until(lambda: len(server.of("cancel_goal")) == 2, "it is told again")


@pytest.mark.parametrize(
    ("name", "answers", "end"),
    [
        ("unheard", {"send_goal": None}, "it was told to end, but its end is not known"),
        (
            "unknown",
            {"send_goal": None, "cancel_goal": b"\2" + bytes(7)},
            "it could not be canceled, and its end is not known",
        ),
        ("ended", {"send_goal": None, "cancel_goal": b"\3" + bytes(7)}, "it was canceled, and has ended"),
        ("dropped", {"send_goal": b""}, "it was told to end, but its end is not known"),
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


# --- ours with ours


def test_a_goal_is_pursued_to_its_end(graph: Ros2, other: Ros2) -> None:
    doing, feedback = Doing(), []
    graph.act("/fib", FIBONACCI, doing)
    pursuit = pursue(other, "fib", 6, feedback.append)
    wait_until(lambda: feedback, "feedback is told")
    doing.go_on.set()
    assert pursuit.wait(LONG_S) == Outcome(Ended.SUCCEEDED, {"sequence": [6]})
    assert doing.goals[0].client == "/client"
    assert feedback == [{"sequence": [0, 1]}]


def test_a_later_goal_cancels_the_one_before(graph: Ros2, other: Ros2) -> None:
    doing = Doing()
    graph.act("/one_at_a_time", FIBONACCI, doing)
    first = pursue(other, "one_at_a_time", 1)
    wait_until(lambda: doing.goals, "the first has begun")
    second = pursue(other, "one_at_a_time", 2)
    assert first.wait(LONG_S) == Outcome(Ended.CANCELED, {"sequence": [1]})
    doing.go_on.set()
    assert second.wait(LONG_S) == Outcome(Ended.SUCCEEDED, {"sequence": [2]})


def test_a_goal_that_fails_is_aborted(graph: Ros2, other: Ros2, caplog: pytest.LogCaptureFixture) -> None:
    def fail(_goal: Goal) -> Outcome:
        raise ValueError("no")

    graph.act("/failing", FIBONACCI, fail)
    assert pursue(other, "failing", 1).wait(LONG_S) == Outcome(Ended.ABORTED, {"sequence": []})


def test_a_result_that_does_not_fit_aborts_the_goal(graph: Ros2, other: Ros2, caplog: pytest.LogCaptureFixture) -> None:
    graph.act("/misfit", FIBONACCI, lambda goal: Outcome(Ended.SUCCEEDED, {"no such field": 1}))
    assert pursue(other, "misfit", 1).wait(LONG_S).how is Ended.ABORTED


def test_an_action_that_is_closed_cancels_its_goals_and_tells_their_end(graph: Ros2, other: Ros2) -> None:
    doing = Doing()
    action = graph.act("/closing", FIBONACCI, doing)
    pursuit = pursue(other, "closing", 1)
    wait_until(lambda: doing.goals and doing.goals[0].waiting, "its client has asked for the result")
    action.close()
    action.close()
    assert pursuit.wait(LONG_S).how is Ended.CANCELED
    served = "/closing/_action/send_goal"
    wait_until(lambda: not other._node.presence.offered(Kind.SERVER, served), "the end of the action is seen")
    with pytest.raises(RosUnreachable, match="no node serves it"):
        other.pursue("/closing", FIBONACCI, {"order": 1})


def test_a_server_that_is_gone_is_noticed(graph: Ros2, other: Ros2, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trade_gateway.ros.ros2._pursuit._GONE_S", 0.1)
    monkeypatch.setattr("trade_gateway.ros.ros2._pursuit._ABANDON_S", 0.1)
    doing = Doing()
    graph.act("/gone", FIBONACCI, doing)
    pursuit = pursue(other, "gone", 1)
    graph._link.close()  # as if it were killed: nothing is told any more
    with pytest.raises(RosUnreachable, match="its server is gone"):
        pursuit.wait(LONG_S)
    doing.go_on.set()


def test_an_action_that_nobody_serves_is_unreachable(graph: Ros2) -> None:
    with pytest.raises(RosUnreachable, match="no node serves it"):
        graph.pursue("/nobody", FIBONACCI, {"order": 1})


def test_a_goal_that_does_not_fit_is_not_sent(graph: Ros2) -> None:
    with pytest.raises(ConfigurationError, match="has no speed; it has order"):
        graph.pursue("/nobody", FIBONACCI, {"speed": 1})


def test_a_service_is_no_action(graph: Ros2) -> None:
    with pytest.raises(ConfigurationError, match="is no action"):
        graph.act("/wrong", "example_interfaces/srv/AddTwoInts", Doing())
