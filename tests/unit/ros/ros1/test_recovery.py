"""Nodes, the master and our own node die and come again; what was open is open again by itself."""

import signal
from pathlib import Path
from typing import Any

import pytest

from tests.support.ros1_system import Stand, our_node
from tests.support.waiting import PATIENCE_S, wait_until
from trade.errors import ConfigurationError
from trade_gateway.ros._graph import Goal, GoalEnd, Outcome, RosUnreachable
from trade_gateway.ros.ros1 import Ros1

pytestmark = pytest.mark.realtime

TEXT = "std_msgs/msg/String"
TRIGGER = "std_srvs/srv/Trigger"


class Watch:
    def __init__(self, graph: Ros1) -> None:
        self.reported: list[tuple[str, bool]] = []
        self.watch = graph.watch_nodes(lambda name, there: self.reported.append((name, there)))

    def until(self, name: str, there: bool) -> None:
        wait_until(lambda: (name, there) in self.reported, f"{name} is reported: {self.reported}")


def answers(graph: Ros1) -> bool:
    try:
        return graph.call("/lights", TRIGGER, {}, PATIENCE_S)["success"]
    except RosUnreachable:
        return False


def test_a_node_that_is_killed_is_reported_gone_and_back(graph: Ros1, stand: Stand) -> None:
    watch = Watch(graph)
    peer = stand.peer("arm")
    watch.until("/arm", there=True)
    peer.end(signal.SIGKILL)
    watch.until("/arm", there=False)
    stand.peer("arm")
    wait_until(lambda: watch.reported.count(("/arm", True)) == 2, "it is reported again")
    assert [there for name, there in watch.reported if name == "/arm"] == [True, False, True]
    assert "/trade" not in {name for name, _ in watch.reported}


def test_a_node_that_ends_is_reported_gone(graph: Ros1, stand: Stand) -> None:
    watch = Watch(graph)
    peer = stand.peer("arm")
    watch.until("/arm", there=True)
    peer.do("end")
    watch.until("/arm", there=False)


def test_a_new_subscriber_gets_the_existing_ones_and_an_ended_one_none(graph: Ros1, stand: Stand) -> None:
    first = Watch(graph)
    stand.peer("arm")
    first.until("/arm", there=True)
    late = Watch(graph)
    late.until("/arm", there=True)
    first.watch.close()
    stand.peer("leg")
    late.until("/leg", there=True)
    assert ("/leg", True) not in first.reported


def test_a_publisher_that_was_killed_and_started_again_is_heard_again(graph: Ros1, stand: Stand) -> None:
    heard: list[str] = []
    graph.subscribe("/state", TEXT, lambda message, who: heard.append(message["data"]), latched=True)
    for life in ("one", "two"):
        peer = stand.peer("arm")
        peer.do("advertise", "/state", "std_msgs/String", True)
        peer.do("send", "/state", {"data": life})
        wait_until(lambda life=life: life in heard, f"life {life} is heard")
        peer.end(signal.SIGKILL)


def open_all(graph: Ros1) -> list[str]:
    """A latched topic, a subscription and a service; what the subscription hears."""
    heard: list[str] = []
    graph.subscribe("/orders", TEXT, lambda message, who: heard.append(message["data"]), latched=True)
    graph.advertise("/state", TEXT, latched=True).send({"data": "kept"})
    graph.serve("/lights", TRIGGER, lambda request, who, at: {"success": True})
    return heard


def are_open_again(peer: Any, heard: list[str]) -> None:
    peer.do("hear", "/state", "std_msgs/String")
    assert peer.wait_for("heard")["data"] == "kept"
    peer.do("advertise", "/orders", "std_msgs/String", True)
    peer.do("send", "/orders", {"data": "go"})
    wait_until(lambda: heard == ["go"], "the subscription is open again")


def test_a_master_that_was_killed_and_restarted_gets_all_registrations_again(graph: Ros1, stand: Stand) -> None:
    heard = open_all(graph)
    watch = Watch(graph)
    old = stand.peer("old")
    watch.until("/old", there=True)

    stand.kill_master()
    wait_until(lambda: graph.healthy.startswith(f"no master at {stand.uri}"), "its end is noticed")
    with pytest.raises(RosUnreachable):
        graph.call("/lights", TRIGGER, {}, 5)
    stand.start_master()
    wait_until(lambda: not graph.healthy, "the new one is noticed")

    peer = stand.peer("fresh")
    watch.until("/fresh", there=True)
    peer.do("call", "/lights", "std_srvs/Trigger", {})
    assert peer.wait_for("called")["success"]
    are_open_again(peer, heard)
    assert ("/old", False) not in watch.reported
    old.end()
    watch.until("/old", there=False)


def test_a_master_that_was_replaced_unnoticed_gets_all_registrations_again(graph: Ros1, stand: Stand) -> None:
    graph.serve("/lights", TRIGGER, lambda request, who, at: {"success": True})
    wait_until(lambda: answers(graph), "its service is found")
    node = our_node()
    node.suspend()
    stand.kill_master()
    stand.start_master()
    node.resume()
    peer = stand.peer("arm")
    peer.do("call", "/lights", "std_srvs/Trigger", {})
    assert peer.wait_for("called")["success"]


def test_a_master_that_comes_late_is_found(stand: Stand, start_ros1: Any) -> None:
    stand.kill_master()
    graph = start_ros1()
    graph.serve("/lights", TRIGGER, lambda request, who, at: {"success": True})
    topic = graph.advertise("/state", TEXT, latched=True)
    topic.send({"data": "early"})
    wait_until(lambda: graph.healthy.startswith("no master at"), "it says so")
    stand.start_master()
    peer = stand.peer("arm")
    peer.do("hear", "/state", "std_msgs/String")
    assert peer.wait_for("heard")["data"] == "early"
    wait_until(lambda: not graph.healthy, "it is found")
    wait_until(lambda: answers(graph), "its service is found")


def test_our_node_that_was_killed_is_started_again_with_everything_that_was_open(graph: Ros1, stand: Stand) -> None:
    heard = open_all(graph)
    peer = stand.peer("arm")
    watch = Watch(graph)
    watch.until("/arm", there=True)
    before = our_node()

    before.kill()
    watch.until("/arm", there=False)
    wait_until(lambda: watch.reported.count(("/arm", True)) == 2, "it is seen again")
    wait_until(lambda: not graph.healthy, "all is well again")
    assert our_node().pid != before.pid
    are_open_again(peer, heard)
    wait_until(lambda: answers(graph), "its service is found")


def test_a_goal_survives_the_death_of_our_node(graph: Ros1, stand: Stand) -> None:
    peer = stand.peer("mover")
    peer.do("act", "/move")
    peer.wait_for("did")
    heard: list[int] = []
    goal = graph.pursue(
        "/move", "actionlib/action/Test", {"goal": 0}, lambda reported: heard.append(reported["feedback"])
    )
    wait_until(lambda: heard, "it runs")
    our_node().kill()
    seen = len(heard)
    wait_until(lambda: len(heard) > seen + 20, "it is heard of again")
    goal.cancel()
    assert goal.wait(PATIENCE_S).how is GoalEnd.CANCELED


def test_a_result_that_arrives_while_our_node_is_dead_is_delivered(graph: Ros1, stand: Stand) -> None:
    killed: list[bool] = []

    def do(goal: Goal) -> Outcome:
        if goal.message["goal"] == 5:
            our_node().kill()
            killed.append(True)
        return Outcome(GoalEnd.SUCCEEDED, {"result": 7})

    graph.act("/move", "actionlib/action/Test", do)
    peer = stand.peer("planner")
    peer.do("pursue", "/move", 5)
    assert peer.wait_for("done")["result"] == 7
    assert killed


def test_our_node_ends_with_its_parent_and_leaves_nothing_at_the_master(stand: Stand, start_ros1: Any) -> None:
    first = start_ros1()
    first.serve("/lights", TRIGGER, lambda request, who, at: {"success": True})
    wait_until(lambda: not first.healthy, "the master knows of us")
    second = start_ros1(node="/other")
    wait_until(lambda: answers(second), "its service is found")
    first.close()
    first.close()
    assert first.healthy
    with pytest.raises(RosUnreachable, match="no node offers it"):
        second.call("/lights", TRIGGER, {}, PATIENCE_S)


def test_our_node_does_not_take_the_name_of_another(stand: Stand, start_ros1: Any) -> None:
    peer = stand.peer("trade")
    graph = start_ros1()
    wait_until(lambda: "there is another node /trade" in graph.healthy, "it says so")
    assert not peer.all("ended")
    peer.end()
    wait_until(lambda: not graph.healthy, "the name is free")


@pytest.mark.parametrize(("python", "says"), [("/nowhere/python3", "cannot be started"), ("/bin/false", "has ended")])
def test_a_path_that_is_no_python_is_reported(python: str, says: str, tmp_path: Path) -> None:
    graph = Ros1("http://127.0.0.1:1", python=python)
    try:
        wait_until(lambda: says in graph.healthy, "it says so")
        with pytest.raises(RosUnreachable):
            graph.call("/lights", TRIGGER, {}, 0.1)
    finally:
        graph.close()


@pytest.mark.skipif(not Path("/usr/bin/python3").exists(), reason="there is no /usr/bin/python3")
def test_a_python_without_rospy_says_what_to_install(tmp_path: Path) -> None:
    python = tmp_path / "python3"
    python.write_text('#!/bin/sh\nexec /usr/bin/python3 -S "$@"\n')
    python.chmod(0o755)
    graph = Ros1("http://127.0.0.1:1", python=str(python))
    try:
        wait_until(lambda: "Install python3-rospy" in graph.healthy, "it says so")
    finally:
        graph.close()


def test_a_node_name_that_is_none_of_ros_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="is not a global name"):
        Ros1(node="trade")
