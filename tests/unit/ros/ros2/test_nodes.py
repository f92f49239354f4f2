"""The present nodes: nodes that come, go, die, and come again under the same name."""

import threading
from collections.abc import Callable

import pytest

from tests.support.ros2_processes import Process, Router, raw_session
from tests.support.waiting import wait_until
from trade_gateway.ros.ros2 import Ros2
from trade_gateway.ros.ros2._names import TokenKind, gid

pytestmark = pytest.mark.realtime


class Reports:
    """Of nodes."""

    def __init__(self) -> None:
        self.all: list[tuple[str, bool]] = []

    def __call__(self, node: str, there: bool) -> None:
        self.all.append((node, there))

    def of(self, node: str) -> list[bool]:
        return [there for name, there in self.all if name == node]


def test_a_new_watcher_is_notified_of_the_nodes_already_present(graph: Ros2, peer: Process) -> None:
    peer.ask("listen", topic="/present")  # its node is one with its endpoint
    peer.hear("listening", topic="/present")
    first, second = Reports(), Reports()
    graph.watch_nodes(first)
    wait_until(lambda: first.of("/sdk"), "the node is seen")
    graph.watch_nodes(second)
    wait_until(lambda: second.of("/sdk"), "a later watcher gets it, too")
    assert set(second.of("/sdk")) == {True}


def test_a_node_in_a_namespace_has_its_whole_name(graph: Ros2, router: Router, open_graph: Callable[..., Ros2]) -> None:
    reported = Reports()
    graph.watch_nodes(reported)
    other = open_graph(router, node="/arm/left/driver")
    wait_until(lambda: reported.of("/arm/left/driver") == [True], "it is reported present")
    other.close()
    wait_until(lambda: reported.of("/arm/left/driver") == [True, False], "it is reported gone")


def test_a_killed_node_is_reported_as_gone(graph: Ros2, router: Router, start_peer: Callable[..., Process]) -> None:
    reported = Reports()
    graph.watch_nodes(reported)
    doomed = start_peer(router, "doomed")
    doomed.ask("listen", topic="/doomed")
    wait_until(lambda: reported.of("/doomed") == [True], "it is reported present")
    doomed.kill()
    wait_until(lambda: reported.of("/doomed") == [True, False], "it is reported gone")
    again = start_peer(router, "doomed")
    again.ask("listen", topic="/doomed")
    wait_until(lambda: reported.of("/doomed") == [True, False, True], "it is reported present again")


def test_a_name_shared_by_two_nodes_is_reported_gone_and_present_when_one_ends(
    graph: Ros2, router: Router, open_graph: Callable[..., Ros2]
) -> None:
    reported = Reports()
    graph.watch_nodes(reported)
    one, other = open_graph(router, node="/twin"), open_graph(router, node="/twin")
    open_graph(router, node="/after_them")
    wait_until(lambda: reported.of("/after_them"), "who came after them is seen")
    one.close()
    wait_until(lambda: reported.of("/twin") == [True, False, True], "the death of one is reported")
    other.close()
    wait_until(lambda: reported.of("/twin") == [True, False, True, False], "the death of the other is reported")


def test_node_lookup_waits_for_a_liveliness_token_that_arrives_late(
    graph: Ros2, router: Router, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trade_gateway.ros.ros2._presence._INTRODUCTION_S", 60.0)
    own = "@ros2_lv/0/abc/0/1/MP/%/%arm/early/%said/std_msgs::msg::dds_::String_/RIHS01_0/::,10:,:,:,,"
    found: list[str] = []
    asking = threading.Thread(target=lambda: found.append(graph._node.presence.node_of(gid(own))))
    asking.start()
    with raw_session(router) as session, session.liveliness().declare_token(own):
        asking.join(60)
    assert found == ["/arm/early"]


EARLY = "@ros2_lv/0/abc/0/1/MP/%/%arm/early/%said/std_msgs::msg::dds_::String_/RIHS01_0/::,10:,:,:,,"


def come_and_go(graph: Ros2, router: Router, token: str) -> None:
    """An endpoint is seen, and its end."""
    presence = graph._node.presence
    with raw_session(router) as session, session.liveliness().declare_token(token):
        wait_until(lambda: token in presence._tokens, "it is seen")
    wait_until(lambda: token not in presence._tokens, "its end is seen")


def test_S05_who_has_just_ended_keeps_its_name_for_a_while(
    graph: Ros2, router: Router, monkeypatch: pytest.MonkeyPatch
) -> None:
    presence = graph._node.presence
    monkeypatch.setattr("trade_gateway.ros.ros2._presence._ENDED_S", 1000.0)
    come_and_go(graph, router, EARLY)
    assert presence.known(gid(EARLY)) == presence.node_of(gid(EARLY)) == "/arm/early"
    monkeypatch.setattr("trade_gateway.ros.ros2._presence._ENDED_S", 0.0)
    come_and_go(graph, router, EARLY)
    assert presence.known(gid(EARLY)) == ""


def test_nothing_is_kept_of_withdrawn_endpoints(graph: Ros2, router: Router) -> None:
    presence = graph._node.presence
    come_and_go(graph, router, EARLY)
    assert (TokenKind.PUBLISHER, "/said") not in presence._offered
    assert not presence.offered(TokenKind.PUBLISHER, "/said")
    assert (TokenKind.PUBLISHER, "/said") not in presence._offered  # nor by asking


def test_of_those_that_ended_only_the_last_ones_keep_their_names(
    graph: Ros2, router: Router, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trade_gateway.ros.ros2._presence._ENDED_S", 1000.0)
    monkeypatch.setattr("trade_gateway.ros.ros2._presence._MOST_ENDED", 2)
    tokens = [EARLY.replace("/0/1/MP", f"/0/{number}/MP") for number in (1, 2, 3)]
    for token in tokens:
        come_and_go(graph, router, token)
    assert [graph._node.presence.known(gid(token)) for token in tokens] == ["", "/arm/early", "/arm/early"]


def test_S07_strangers_are_waited_for_one_after_another_with_pauses(
    graph: Ros2, monkeypatch: pytest.MonkeyPatch
) -> None:
    presence = graph._node.presence
    monkeypatch.setattr("trade_gateway.ros.ros2._presence._PAUSE_S", 1000.0)
    monkeypatch.setattr("trade_gateway.ros.ros2._presence._INTRODUCTION_S", 0.01)
    assert presence.node_of(b"one") == ""
    monkeypatch.setattr("trade_gateway.ros.ros2._presence._INTRODUCTION_S", 1000.0)
    assert [presence.node_of(each) for each in (b"one", b"two", b"three")] == ["", "", ""]


def test_the_node_watch_does_not_report_its_own_node(
    graph: Ros2, router: Router, open_graph: Callable[..., Ros2]
) -> None:
    reported = Reports()
    graph.watch_nodes(reported)
    open_graph(router, node="/other")
    wait_until(lambda: reported.of("/other"), "another is reported")
    assert not reported.of("/trade")


def test_another_domain_is_not_seen(graph: Ros2, router: Router, open_graph: Callable[..., Ros2]) -> None:
    reported = Reports()
    graph.watch_nodes(reported)
    open_graph(router, node="/far", domain_id=7)
    open_graph(router, node="/near")
    wait_until(lambda: reported.of("/near"), "who came later is seen")
    assert not reported.of("/far")


def test_a_closed_watch_receives_no_more_notifications(
    graph: Ros2, router: Router, open_graph: Callable[..., Ros2]
) -> None:
    ended, other = Reports(), Reports()
    watch = graph.watch_nodes(ended)
    graph.watch_nodes(other)
    watch.close()
    watch.close()
    open_graph(router, node="/later")
    wait_until(lambda: other.of("/later"), "it is reported")
    assert not ended.of("/later")
