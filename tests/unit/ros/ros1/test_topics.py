"""Topics of either side, heard by the other."""

import threading
from typing import Any

import pytest

from tests.support.ros1_system import Stand
from tests.support.waiting import wait_until
from trade.errors import ConfigurationError
from trade_gateway.ros.ros1 import Ros1

TEXT = "std_msgs/msg/String"
JOINTS = "sensor_msgs/msg/JointState"


def send_until(graph_sends: Any, heard: Any) -> None:
    """A topic has no memory: what is sent before the other end is connected is lost."""

    def look() -> bool:
        if not heard():
            graph_sends()
        return bool(heard())

    wait_until(look, "it was heard")


@pytest.mark.slow
def test_a_node_hears_what_is_published_here(graph: Ros1, stand: Stand) -> None:
    peer = stand.peer("listener")
    peer.do("hear", "/joints", "sensor_msgs/JointState")
    joints = graph.advertise("/joints", JOINTS)
    message = {"header": {"frame_id": "base", "stamp": {"sec": 3, "nanosec": 5}}, "name": ["pan"], "position": [0.25]}
    send_until(lambda: joints.send(message), lambda: peer.all("heard"))
    reported = peer.all("heard")[0]
    assert reported["who"] == "/trade"
    assert reported["header"]["stamp"] == {"secs": 3, "nsecs": 5}
    assert reported["header"]["frame_id"] == "base"
    assert (reported["name"], reported["position"], reported["velocity"]) == (["pan"], [0.25], [])


@pytest.mark.slow
def test_what_a_node_publishes_is_heard_here_with_its_name(graph: Ros1, stand: Stand) -> None:
    heard: list[Any] = []
    graph.subscribe("/joints", JOINTS, lambda message, who: heard.append((message, who)))
    peer = stand.peer("arm")
    peer.do("advertise", "/joints", "sensor_msgs/JointState")
    values = {"header": {"frame_id": "base"}, "name": ["pan"], "position": [0.25]}
    send_until(lambda: peer.do("send", "/joints", values), lambda: heard)
    message, who = heard[0]
    assert who == "/arm"
    assert (message["header"]["frame_id"], message["name"], message["position"]) == ("base", ["pan"], [0.25])


@pytest.mark.slow
def test_a_late_subscriber_gets_the_last_message_of_a_latched_topic(graph: Ros1, stand: Stand) -> None:
    topic = graph.advertise("/map", TEXT, latched=True)
    topic.send({"data": "old"})
    topic.send({"data": "new"})
    peer = stand.peer("late")
    peer.do("hear", "/map", "std_msgs/String")
    assert peer.wait_for("heard")["data"] == "new"


@pytest.mark.slow
def test_the_last_message_of_a_latched_ros_topic_is_received(graph: Ros1, stand: Stand) -> None:
    peer = stand.peer("mapper")
    peer.do("advertise", "/map", "std_msgs/String", True)
    peer.do("send", "/map", {"data": "kept"})
    peer.wait_for("did", lambda what: what == "send")
    heard: list[Any] = []
    graph.subscribe("/map", TEXT, lambda message, who: heard.append((message["data"], who)), latched=True)
    wait_until(lambda: heard == [("kept", "/mapper")], "it was heard")


@pytest.mark.slow
def test_S01_what_was_published_before_is_no_command(graph: Ros1, stand: Stand) -> None:
    peer = stand.peer("pilot")
    peer.do("advertise", "/go", "std_msgs/String", True)
    peer.do("send", "/go", {"data": "old"})
    peer.wait_for("did", lambda what: what == "send")
    heard: list[str] = []
    graph.subscribe("/go", TEXT, lambda message, _who: heard.append(message["data"]))
    graph.subscribe("/go", TEXT, lambda message, _who: heard.append(message["data"]))

    def said() -> bool:
        peer.do("send", "/go", {"data": "new"})
        threading.Event().wait(0.05)
        return len(heard) > 1

    wait_until(said, "what is sent now was heard")
    assert set(heard) == {"new"}


@pytest.mark.slow
def test_a_listener_that_is_frozen_delays_no_other(graph: Ros1, stand: Stand) -> None:
    slow, quick = stand.peer("slow"), stand.peer("quick")
    for peer in (slow, quick):
        peer.do("hear", "/much", "std_msgs/String")
    topic = graph.advertise("/much", TEXT)
    send_until(lambda: topic.send({"data": "first"}), lambda: slow.all("heard") and quick.all("heard"))
    slow.freeze()
    for number in range(400):
        topic.send({"data": f"{number:08}" + "x" * 100_000})
    send_until(lambda: topic.send({"data": "last"}), lambda: any(one["data"] == "last" for one in quick.all("heard")))


@pytest.mark.slow
def test_a_slow_callback_gets_the_newest_message(graph: Ros1, stand: Stand) -> None:
    heard: list[str] = []
    begun, go_on = threading.Event(), threading.Event()

    def slow(message: dict[str, Any], who: str) -> None:
        heard.append(message["data"])
        begun.set()
        assert go_on.wait(60)

    graph.subscribe("/count", TEXT, slow)
    seen: list[str] = []
    graph.subscribe("/count", TEXT, lambda message, who: seen.append(message["data"]))
    topic = graph.advertise("/count", TEXT)
    send_until(lambda: topic.send({"data": "first"}), begun.is_set)
    for number in range(100):
        wait_until(lambda number=number: _sent(topic, number, seen), "it was heard next door")
    go_on.set()
    wait_until(lambda: heard[-1] == "99", "the newest came")
    assert len(heard) < 50


def _sent(topic: Any, number: int, seen: list[str]) -> bool:
    if str(number) not in seen:
        topic.send({"data": str(number)})
    return str(number) in seen


@pytest.mark.slow
def test_a_closed_subscription_hears_nothing_and_another_continues(graph: Ros1) -> None:
    first: list[str] = []
    second: list[str] = []
    one = graph.subscribe("/both", TEXT, lambda message, who: first.append(message["data"]))
    graph.subscribe("/both", TEXT, lambda message, who: second.append(message["data"]))
    topic = graph.advertise("/both", TEXT)
    send_until(lambda: topic.send({"data": "a"}), lambda: first and second)
    one.close()
    one.close()
    send_until(lambda: topic.send({"data": "b"}), lambda: "b" in second)
    assert "b" not in first


@pytest.mark.slow
def test_a_topic_that_is_closed_and_opened_at_once_is_heard_at_both_ends(graph: Ros1, stand: Stand) -> None:
    peer = stand.peer("arm")
    peer.do("hear", "/state", "std_msgs/String")
    peer.do("advertise", "/orders", "std_msgs/String", True)
    peer.do("send", "/orders", {"data": "go"})
    for number in range(5):
        heard: list[str] = []
        topic = graph.advertise("/state", TEXT, latched=True)
        orders = graph.subscribe(
            "/orders", TEXT, lambda message, who, heard=heard: heard.append(message["data"]), latched=True
        )
        topic.send({"data": str(number)})
        peer.wait_for("heard", lambda reported, number=number: reported["data"] == str(number))
        wait_until(lambda heard=heard: heard, "it was heard here")
        orders.close()
        topic.close()


@pytest.mark.slow
def test_what_does_not_fit_is_refused_where_it_is_sent(graph: Ros1) -> None:
    with pytest.raises(ConfigurationError, match="has no dada"):
        graph.advertise("/text", TEXT).send({"dada": "x"})


@pytest.mark.slow
def test_a_name_that_is_none_of_ros_is_refused(graph: Ros1) -> None:
    for name in ("text", "/", "/a b", "/1st", "/a/", "", "/a\n"):
        with pytest.raises(ConfigurationError, match="is not a global name"):
            graph.advertise(name, TEXT)


@pytest.mark.slow
def test_a_topic_cannot_be_of_two_types_here(graph: Ros1) -> None:
    graph.subscribe("/one", TEXT, lambda message, who: None)
    with pytest.raises(ConfigurationError, match="is open as std_msgs/String already"):
        graph.advertise("/one", JOINTS)
