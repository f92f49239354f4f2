"""The router of ROS 2 is not there yet, is killed, comes back: what was open works again, and nothing comes late."""

import threading
from collections.abc import Callable

import pytest

from tests.support.ros2_processes import Process, Router, until_heard
from tests.support.waiting import wait_until
from trade.errors import ConfigurationError
from trade_gateway.ros._graph import RosUnreachable
from trade_gateway.ros.ros2 import Ros2

STRING = "std_msgs/msg/String"
ADD = "example_interfaces/srv/AddTwoInts"
LONG_S = 60.0


@pytest.mark.slow
def test_endpoints_created_without_a_router_work_once_the_router_starts(
    own_router: Router, open_graph: Callable[..., Ros2], start_peer: Callable[..., Process]
) -> None:
    graph = open_graph(own_router)
    heard: list[str] = []
    graph.subscribe("/from_them", STRING, lambda message, _: heard.append(message["data"]))
    graph.serve("/add", ADD, lambda request, _who, _at: {"sum": request["a"] + request["b"]})
    latched = graph.advertise("/latched", STRING, latched=True)
    latched.send({"data": "said before there was a router"})
    assert "no zenoh router" in graph.healthy
    with pytest.raises(RosUnreachable, match="no zenoh router"):
        graph.call("/add", ADD, {}, LONG_S)
    own_router.start()
    wait_until(lambda: not graph.healthy, "our graph has found the router")
    peer = start_peer(own_router, "sdk")
    peer.ask("listen", topic="/latched", latched=True)
    peer.hear("heard", data="said before there was a router")
    peer.ask("add", service="/add", a=1, b=2)
    assert peer.hear("added")["sum"] == 3
    until_heard(lambda: peer.ask("publish", topic="/from_them", data="at last"), lambda: heard)


@pytest.mark.slow
def test_a_router_that_was_killed_and_started_again_finds_all_as_it_was(
    own_router: Router, open_graph: Callable[..., Ros2], start_peer: Callable[..., Process]
) -> None:
    own_router.start()
    graph = open_graph(own_router)
    peer = start_peer(own_router, "sdk")
    heard: list[str] = []
    nodes: list[bool] = []
    graph.watch_nodes(lambda node, there: nodes.append(there) if node == "/sdk" else None)
    graph.subscribe("/from_them", STRING, lambda message, _: heard.append(message["data"]))
    publisher = graph.advertise("/from_us", STRING)
    graph.serve("/add_ours", ADD, lambda request, _who, _at: {"sum": request["a"] + request["b"]})
    peer.ask("listen", topic="/from_us")
    peer.ask("serve", service="/add_theirs")
    peer.hear("serving")
    until_heard(lambda: publisher.send({"data": "before"}), lambda: peer.has("heard", data="before"))
    wait_until(lambda: nodes and nodes[-1], "the node is reported present")

    own_router.kill()
    wait_until(lambda: "no zenoh router" in graph.healthy, "our graph has noticed")
    wait_until(lambda: not nodes[-1], "the node is reported gone")
    publisher.send({"data": "while it was gone"})
    with pytest.raises(RosUnreachable, match="no zenoh router"):
        graph.call("/add_theirs", ADD, {}, LONG_S)

    own_router.start()
    wait_until(lambda: not graph.healthy, "our graph has found it again")
    wait_until(lambda: nodes[-1], "the node is reported present again")
    until_heard(lambda: publisher.send({"data": "after"}), lambda: peer.has("heard", data="after"))
    until_heard(lambda: peer.ask("publish", topic="/from_them", data="after"), lambda: "after" in heard)
    peer.ask("add", service="/add_ours", a=4, b=5)
    assert peer.hear("added")["sum"] == 9
    wait_until(lambda: _answers(graph, "/add_theirs"), "their service is reached again")
    assert not peer.has("heard", data="while it was gone")


def test_a_graph_that_never_finds_a_router_ends_too(own_router: Router, open_graph: Callable[..., Ros2]) -> None:
    graph = open_graph(own_router)
    graph.advertise("/topic", STRING).send({"data": "to no node"})
    graph.close()
    graph.close()
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("ros2")]


@pytest.mark.parametrize("router", ["", "localhost", "tcp/", "7447"])
def test_what_is_no_address_of_a_router_is_refused(router: str) -> None:
    with pytest.raises(ConfigurationError, match="tcp/localhost:7447"):
        Ros2(router)


@pytest.mark.parametrize("node", ["trade", "/a b", "/"])
def test_what_is_no_name_of_a_node_is_refused(own_router: Router, node: str) -> None:
    with pytest.raises(ConfigurationError, match="must be absolute, such as /like/this_1"):
        Ros2(own_router.endpoint, node=node)


def test_a_domain_below_0_is_refused(own_router: Router) -> None:
    with pytest.raises(ConfigurationError, match="must be 0 or more"):
        Ros2(own_router.endpoint, domain_id=-1)


def _answers(graph: Ros2, service: str) -> bool:
    try:
        return graph.call(service, ADD, {"a": 1, "b": 1}, LONG_S) == {"sum": 2}
    except RosUnreachable:
        return False
