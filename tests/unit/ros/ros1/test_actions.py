"""Actions of either side, with the actionlib of ROS 1 at the other."""

import itertools
import os
import signal
import threading
import time
from typing import Any

import pytest

from tests.support.ros1_system import Peer, Stand, our_node
from tests.support.waiting import PATIENCE_S, wait_until
from trade_gateway.ros._graph import ActionGoal, Goal, GoalEnd, Outcome, RosRefused, RosUnreachable
from trade_gateway.ros.ros1 import Ros1, _action_client

pytestmark = pytest.mark.realtime

TEST = "actionlib/action/Test"
ENDLESS, ABORTS, HANGS = 0, -1, -2
SUCCEEDED, PREEMPTED, ABORTED, REJECTED, RECALLED = 3, 2, 4, 5, 8


def server(stand: Stand, name: str = "mover", job: str = "act") -> Peer:
    peer = stand.peer(name)
    peer.do(job, "/move")
    peer.wait_for("did")
    return peer


def pursue(graph: Ros1, goal: int, heard: list[int] | None = None) -> ActionGoal:
    def feedback(message: dict[str, Any]) -> None:
        if heard is not None:
            heard.append(message["feedback"])

    return graph.pursue("/move", TEST, {"goal": goal}, feedback)


def test_a_goal_is_pursued_to_its_end_with_feedback(graph: Ros1, stand: Stand) -> None:
    server(stand)
    heard: list[int] = []
    outcome = pursue(graph, 20, heard).wait(PATIENCE_S)
    assert outcome == Outcome(GoalEnd.SUCCEEDED, {"result": 20}, "there")
    assert heard  # feedback and result come on connections of their own, so the last of it may be late
    assert heard == list(range(1, len(heard) + 1))


def test_a_goal_is_canceled(graph: Ros1, stand: Stand) -> None:
    server(stand)
    heard: list[int] = []
    goal = pursue(graph, ENDLESS, heard)
    wait_until(lambda: heard, "it runs")
    goal.cancel()
    outcome = goal.wait(PATIENCE_S)
    assert (outcome.how, outcome.text) == (GoalEnd.CANCELED, "as you wish")


def test_a_goal_that_the_server_aborts_says_so(graph: Ros1, stand: Stand) -> None:
    server(stand)
    assert pursue(graph, ABORTS).wait(PATIENCE_S) == Outcome(GoalEnd.ABORTED, {"result": ABORTS}, "too far")


def test_a_goal_that_is_rejected_is_refused(graph: Ros1, stand: Stand) -> None:
    server(stand, job="reject")
    with pytest.raises(RosRefused, match="/move: not now"):
        pursue(graph, 1).wait(PATIENCE_S)


def test_an_action_without_a_server_is_unreachable(graph: Ros1, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_action_client, "_THERE_S", 0.2)
    with pytest.raises(RosUnreachable, match="/move: no node serves this action"):
        pursue(graph, 1)


def test_a_goal_whose_end_does_not_come_in_time_is_given_up_and_can_be_canceled_yet(graph: Ros1, stand: Stand) -> None:
    server(stand)
    goal = pursue(graph, ENDLESS)
    with pytest.raises(RosUnreachable, match="its end was not received within"):
        goal.wait(0.05)
    goal.cancel()
    assert goal.wait(PATIENCE_S).how is GoalEnd.CANCELED


def test_a_goal_whose_server_is_killed_fails_and_the_next_server_takes_goals(graph: Ros1, stand: Stand) -> None:
    heard: list[int] = []
    first = server(stand)
    goal = pursue(graph, HANGS, heard)
    wait_until(lambda: heard, "it runs")
    first.end()
    with pytest.raises(RosUnreachable, match="server /mover is gone"):
        goal.wait(PATIENCE_S)
    server(stand)
    assert pursue(graph, 2).wait(PATIENCE_S).how is GoalEnd.SUCCEEDED


class Lossy:
    """A publisher whose first messages are lost, as they are while no node is connected yet."""

    def __init__(self, real: Any, lost: int) -> None:
        self.real = real
        self.lost = lost

    def send(self, message: Any) -> None:
        if self.lost:
            self.lost -= 1
        else:
            self.real.send(message)

    def close(self) -> None:
        self.real.close()


def test_a_cancel_that_is_lost_is_sent_again(graph: Ros1, stand: Stand, monkeypatch: pytest.MonkeyPatch) -> None:
    peer = server(stand)
    goal = pursue(graph, ENDLESS)
    client = graph._clients["/move"]
    monkeypatch.setattr(client, "_cancel", Lossy(client._cancel, 3))
    goal.cancel()
    assert goal.wait(PATIENCE_S).how is GoalEnd.CANCELED
    peer.wait_for("preempted")


def test_a_goal_is_canceled_while_our_node_is_dead(graph: Ros1, stand: Stand) -> None:
    server(stand)
    heard: list[int] = []
    goal = pursue(graph, ENDLESS, heard)
    wait_until(lambda: heard, "it runs")
    our_node().kill()
    goal.cancel()
    assert goal.wait(PATIENCE_S).how is GoalEnd.CANCELED


def test_a_goal_that_was_given_up_is_canceled_when_its_server_is_heard_again(
    graph: Ros1, stand: Stand, monkeypatch: pytest.MonkeyPatch
) -> None:
    peer = server(stand)
    heard: list[int] = []
    goal = pursue(graph, ENDLESS, heard)
    wait_until(lambda: heard, "it runs")
    client = graph._clients["/move"]
    monkeypatch.setattr(client, "_cancel", Lossy(client._cancel, 1))
    peer.freeze()
    monkeypatch.setattr(_action_client, "_SILENT_S", 1.0)
    with pytest.raises(RosUnreachable, match="has sent no status of it"):
        goal.wait(PATIENCE_S)
    os.kill(peer.pid, signal.SIGCONT)
    peer.wait_for("preempted")


def test_calls_in_progress_are_canceled_when_we_close(graph: Ros1, stand: Stand) -> None:
    peer = server(stand)
    heard: list[int] = []
    goal = pursue(graph, ENDLESS, heard)
    wait_until(lambda: heard, "it runs")
    client = graph._clients["/move"]
    graph.close()
    peer.wait_for("preempted")
    assert goal.wait(0).how is GoalEnd.CANCELED
    with pytest.raises(RosUnreachable):
        client.pursue({"goal": 1}, None)


def client(stand: Stand, goal: int, name: str = "planner") -> Peer:
    peer = stand.peer(name)
    peer.do("pursue", "/move", goal)
    return peer


class Mover:
    """What an action of TRADE does: as the goal says, and until it is canceled."""

    def __init__(self) -> None:
        self.came: list[tuple[int, str]] = []
        self.times: list[float] = []
        self.canceled: list[int] = []
        self.go_on = threading.Event()
        self.go_on.set()

    def do(self, goal: Goal) -> Outcome:
        number = goal.message["goal"]
        self.came.append((number, goal.client))
        self.times.append(goal.came_at)
        ends = threading.Event()
        goal.when_canceled(ends.set)
        if number == ENDLESS:
            assert ends.wait(PATIENCE_S)
            self.canceled.append(number)
            return Outcome(GoalEnd.CANCELED, {"result": 1}, "stopped")
        if number == ABORTS:
            raise RuntimeError("a joint is stuck")
        for step in range(1, number + 1):
            goal.feedback({"feedback": step})
        assert self.go_on.wait(PATIENCE_S)
        return Outcome(GoalEnd.SUCCEEDED, {"result": number}, "done")


@pytest.fixture
def mover(graph: Ros1) -> Mover:
    made = Mover()
    graph.act("/move", TEST, made.do)
    return made


def test_a_client_has_its_goal_done_with_feedback(mover: Mover, stand: Stand) -> None:
    mover.go_on.clear()
    began = time.monotonic()
    peer = client(stand, 3)
    wait_until(lambda: peer.all("feedback") == [1, 2, 3], "its feedback was heard")
    mover.go_on.set()
    assert peer.wait_for("done") == {"goal": 3, "state": SUCCEEDED, "result": 3, "text": "done"}
    assert mover.came == [(3, "/planner")]
    assert began < mover.times[0] < time.monotonic()


def test_a_client_learns_why_its_goal_is_rejected_and_the_one_before_it_continues(graph: Ros1, stand: Stand) -> None:
    mover = Mover()
    mover.go_on.clear()

    def refuse(message: dict[str, int]) -> Outcome | None:
        return Outcome(GoalEnd.ABORTED, {"result": -7}, "too far") if message["goal"] > 9 else None

    graph.act("/move", TEST, mover.do, refuse)
    first = client(stand, 3)
    wait_until(lambda: mover.came, "it has begun")
    second = client(stand, 10, "other")
    assert second.wait_for("done") == {"goal": 10, "state": REJECTED, "result": -7, "text": "too far"}
    mover.go_on.set()
    assert first.wait_for("done")["state"] == SUCCEEDED
    assert [number for number, _ in mover.came] == [3]


def test_a_goal_that_was_published_before_is_not_done_again(mover: Mover, stand: Stand) -> None:
    peer = stand.peer("planner")
    peer.do("advertise", "/move/goal", "actionlib/TestActionGoal", True)
    peer.do("send", "/move/goal", {"goal_id": {"id": "old"}, "goal": {"goal": 3}})
    peer.do("meet", "/move/goal")
    peer.wait_for("met")
    numbers = itertools.count(1)

    def send_another() -> bool:
        peer.do("send", "/move/goal", {"goal_id": {"id": f"new-{next(numbers)}"}, "goal": {"goal": 4}})
        return bool(mover.came)

    wait_until(send_another, "a new one is done")
    assert set(mover.came) == {(4, "/planner")}


def test_a_client_cancels_its_goal(mover: Mover, stand: Stand) -> None:
    peer = client(stand, ENDLESS)
    peer.wait_for("active")
    peer.do("cancel", "/move")
    assert peer.wait_for("done") == {"goal": ENDLESS, "state": PREEMPTED, "result": 1, "text": "stopped"}


def test_a_goal_without_a_time_is_met_by_a_cancel_of_all_until_now(mover: Mover, stand: Stand) -> None:
    peer = stand.peer("planner")
    peer.do("advertise", "/move/goal", "actionlib/TestActionGoal")
    peer.do("meet", "/move/goal")
    peer.wait_for("met")
    peer.do("send", "/move/goal", {"goal_id": {"id": "timeless"}, "goal": {"goal": ENDLESS}})
    wait_until(lambda: mover.came, "it runs")
    other = stand.peer("stopper")
    other.do("advertise", "/move/cancel", "actionlib_msgs/GoalID")
    other.do("meet", "/move/cancel")
    other.wait_for("met")
    seconds, nanoseconds = divmod(time.time_ns(), 1_000_000_000)
    other.do("send", "/move/cancel", {"stamp": {"secs": seconds, "nsecs": nanoseconds}})
    wait_until(lambda: mover.canceled, "it is canceled")


def test_a_client_receives_reports_of_failures(mover: Mover, stand: Stand) -> None:
    reported = client(stand, ABORTS).wait_for("done")
    assert (reported["state"], reported["text"]) == (ABORTED, "a joint is stuck")


def test_a_result_that_does_not_fit_ends_the_goal_as_aborted(graph: Ros1, stand: Stand) -> None:
    graph.act("/move", TEST, lambda goal: Outcome(GoalEnd.SUCCEEDED, {"resolt": 1}))
    reported = client(stand, 1).wait_for("done")
    assert reported["state"] == ABORTED
    assert "has no resolt" in reported["text"]


def test_a_later_goal_of_any_client_ends_the_one_before_and_is_done(mover: Mover, stand: Stand) -> None:
    first = client(stand, ENDLESS, "first")
    first.wait_for("active")
    second = client(stand, 2, "second")
    assert second.wait_for("done")["state"] == SUCCEEDED
    assert first.wait_for("done")["state"] == PREEMPTED
    assert mover.came == [(ENDLESS, "/first"), (2, "/second")]


def test_a_goal_that_waits_for_the_end_of_another_is_recalled_by_the_next(graph: Ros1, stand: Stand) -> None:
    go_on = threading.Event()
    done: list[int] = []

    def do(goal: Goal) -> Outcome:
        done.append(goal.message["goal"])
        assert go_on.wait(PATIENCE_S)
        return Outcome(GoalEnd.SUCCEEDED, {})

    graph.act("/move", TEST, do)
    peers: list[Peer] = []
    for number in (1, 2, 3):
        peers.append(client(stand, number, f"client{number}"))
        if number < 3:
            wait_until(lambda: _states(graph, stand) >= len(peers), "it is known")
    assert peers[1].wait_for("done")["state"] == RECALLED
    go_on.set()
    assert peers[0].wait_for("done")["state"] == SUCCEEDED
    assert peers[2].wait_for("done")["state"] == SUCCEEDED
    assert done == [1, 3]


def _states(graph: Ros1, stand: Stand) -> int:
    """How many goals the action reports."""
    seen: list[int] = []
    heard = graph.subscribe(
        "/move/status",
        "actionlib_msgs/msg/GoalStatusArray",
        lambda reported, who: seen.append(len(reported["status_list"])),
    )
    wait_until(lambda: seen, "its state is reported")
    heard.close()
    return seen[-1]


def test_an_action_that_is_withdrawn_ends_what_runs(graph: Ros1, stand: Stand) -> None:
    mover = Mover()
    action = graph.act("/move", TEST, mover.do)
    peer = client(stand, ENDLESS)
    peer.wait_for("active")
    action.close()
    action.close()
    assert mover.canceled == [ENDLESS]


def test_our_two_ends_understand_each_other(mover: Mover, graph: Ros1) -> None:
    heard: list[int] = []
    assert pursue(graph, 3, heard).wait(PATIENCE_S) == Outcome(GoalEnd.SUCCEEDED, {"result": 3}, "done")
    goal = pursue(graph, ENDLESS)
    wait_until(lambda: (ENDLESS, "/trade") in mover.came, "it runs")
    goal.cancel()
    assert goal.wait(PATIENCE_S).how is GoalEnd.CANCELED
