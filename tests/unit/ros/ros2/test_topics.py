"""Topics, with a node of zenoh-ros2-sdk at the other end; what that package cannot do, with zenoh itself."""

import threading
from typing import Any

import pytest

from tests.support.ros2_processes import Process, Router, raw_session, until_heard
from tests.support.waiting import wait_until
from trade.errors import ConfigurationError
from trade_gateway.ros.ros2 import Ros2

pytestmark = pytest.mark.realtime

STRING = "std_msgs/msg/String"


class Heard:
    """What was heard, and from whom."""

    def __init__(self) -> None:
        self.all: list[tuple[str, str]] = []

    def __call__(self, message: dict[str, Any], who: str) -> None:
        self.all.append((message["data"], who))

    @property
    def texts(self) -> list[str]:
        return [text for text, _ in self.all]


def test_what_another_node_publishes_is_heard(graph: Ros2, peer: Process) -> None:
    heard = Heard()
    graph.subscribe("/from_them", STRING, heard)
    until_heard(lambda: peer.ask("publish", topic="/from_them", data="grüß Gott"), lambda: heard.all)
    assert heard.texts[0] == "grüß Gott"


def test_what_we_publish_is_heard_by_another_node(graph: Ros2, peer: Process) -> None:
    peer.ask("listen", topic="/from_us")
    peer.hear("listening", topic="/from_us")
    publisher = graph.advertise("/from_us", STRING)
    until_heard(lambda: publisher.send({"data": "hallo"}), lambda: peer.has("heard", topic="/from_us", data="hallo"))


def test_a_closed_subscription_hears_no_more(graph: Ros2, peer: Process) -> None:
    ended, other = Heard(), Heard()
    subscription = graph.subscribe("/ends", STRING, ended)
    graph.subscribe("/ends", STRING, other)
    until_heard(lambda: peer.ask("publish", topic="/ends", data="before"), lambda: ended.all)
    subscription.close()
    subscription.close()
    until_heard(lambda: peer.ask("publish", topic="/ends", data="after"), lambda: "after" in other.texts)
    assert "after" not in ended.texts


def test_a_late_subscriber_gets_the_latched_message(graph: Ros2, peer: Process) -> None:
    latched = graph.advertise("/latched", STRING, latched=True)
    latched.send({"data": "first"})
    latched.send({"data": "last"})
    peer.ask("listen", topic="/latched", latched=True)
    peer.hear("heard", topic="/latched", data="last")
    assert not peer.has("heard", topic="/latched", data="first")


def test_only_latched_subscribers_receive_earlier_messages(graph: Ros2, router: Router, open_graph: Any) -> None:
    latched = graph.advertise("/map", STRING, latched=True)
    latched.send({"data": "before"})
    late = open_graph(router, node="/late")
    asks, does_not = Heard(), Heard()
    late.subscribe("/map", STRING, does_not)
    late.subscribe("/map", STRING, asks, latched=True)
    wait_until(lambda: asks.all, "the latched message has come")
    until_heard(lambda: latched.send({"data": "now"}), lambda: "now" in does_not.texts)
    assert asks.all[0] == ("before", "/trade")
    assert "before" not in does_not.texts


def test_a_sender_is_known_by_the_token_of_its_publisher(graph: Ros2, router: Router, open_graph: Any) -> None:
    other = open_graph(router, node="/arm/teleop")
    heard = Heard()
    graph.subscribe("/named", STRING, heard)
    publisher = other.advertise("/named", STRING)
    until_heard(lambda: publisher.send({"data": "it is me"}), lambda: heard.all)
    assert heard.all[0] == ("it is me", "/arm/teleop")


def test_a_sender_whose_gid_is_not_of_its_token_has_no_name(graph: Ros2, peer: Process) -> None:
    heard = Heard()
    graph.subscribe("/unnamed", STRING, heard)
    until_heard(lambda: peer.ask("publish", topic="/unnamed", data="who am I"), lambda: heard.all)
    assert heard.all[0] == ("who am I", "")


def test_while_a_subscriber_is_busy_only_the_newest_wait(graph: Ros2, router: Router, open_graph: Any) -> None:
    busy, go_on, arrived = threading.Event(), threading.Event(), Heard()
    slow: list[str] = []

    def take_long(message: dict[str, Any], _who: str) -> None:
        slow.append(message["data"])
        busy.set()
        assert go_on.wait(60)

    graph.subscribe("/fast", STRING, take_long)
    graph.subscribe("/fast", STRING, arrived)
    publisher = open_graph(router, node="/fast_one").advertise("/fast", STRING)
    until_heard(lambda: publisher.send({"data": "0"}), lambda: busy.is_set() and arrived.texts)
    for number in range(30):
        publisher.send({"data": f"burst {number}"})
    until_heard(lambda: publisher.send({"data": "burst 29"}), lambda: "burst 29" in arrived.texts)  # links may drop it
    go_on.set()
    until_heard(lambda: publisher.send({"data": "end"}), lambda: "end" in slow)
    bursts = [text for text in slow if text.startswith("burst")]
    assert len(bursts) < 20  # ten wait, and a few may come after it continues


def test_malformed_ros_messages_are_dropped(graph: Ros2, router: Router, caplog: pytest.LogCaptureFixture) -> None:
    heard = Heard()
    graph.subscribe("/broken", STRING, heard)
    key = f"0/broken/std_msgs::msg::dds_::String_/{graph.types.hash(STRING)}"
    with raw_session(router) as raw:
        good = graph.types.to_bytes(STRING, {"data": "good"})
        raw.put(key, b"\0\1\0\0\xff\xff\xff\xff")
        until_heard(lambda: raw.put(key, good, attachment=b"what is this"), lambda: heard.all)
    assert set(heard.all) == {("good", "")}


def test_a_message_that_does_not_fit_is_refused(graph: Ros2) -> None:
    publisher = graph.advertise("/picky", STRING)
    with pytest.raises(ConfigurationError, match="has no text; it has data"):
        publisher.send({"text": "hallo"})


@pytest.mark.parametrize("name", ["relative", "/a//b", "/a/*", "/1st", "/two__underscores", "/ends/", "", "/"])
def test_a_topic_that_ros_has_no_name_for_is_refused(graph: Ros2, name: str) -> None:
    with pytest.raises(ConfigurationError, match="must be absolute, such as /like/this_1"):
        graph.advertise(name, STRING)
