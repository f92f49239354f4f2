"""The live view: what a viewer of the Foxglove WebSocket protocol gets, and that it cannot hold up who shows it."""

import logging
import sys
from collections.abc import Generator

import pytest
from typer.testing import CliRunner
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from tests.support.foxglove_viewer import viewer
from tests.support.waiting import wait_until
from trade.errors import ConfigurationError
from trade_gateway.cli import app
from trade_gateway.recording._channels import (
    FAULTS,
    LOCKS,
    Channel,
    Fault,
    JointStates,
    Locks,
    Message,
    encoded,
    joints_channel,
    picture,
)
from trade_gateway.recording._live import Live


@pytest.fixture(scope="module", autouse=True)
def _runtime() -> None:
    """The server's runtime opens its files, and begins its threads, once a process; that is no leak."""
    with Live("127.0.0.1", 0, "warm-up") as live, viewer(live.url):
        pass


@pytest.fixture(autouse=True)
def _ignore_threads_of_the_runtime(monkeypatch: pytest.MonkeyPatch) -> None:
    """A log record that asks for its thread's name would have Python keep one of the runtime's as its own."""
    monkeypatch.setattr(logging, "logThreads", False)


@pytest.fixture
def live() -> Generator[Live]:
    with Live("127.0.0.1", 0, "TRADE system lab", outbox=8) as made:
        yield made


def joints(at_ns: int, position_rad: float = 0.0) -> Message:
    states = JointStates(
        names=["rosie.neck.pan"],
        position_rad=[position_rad],
        velocity_rad_s=[0.0],
        load=[],
        enabled=[True],
        fault=[""],
        stamp_s=[1.0],
    )
    return Message(joints_channel("rosie.head"), at_ns, at_ns, encoded(states))


def fault(text: str, about: str = "rosie.neck") -> Message:
    return Message(FAULTS, 7, 7, encoded(Fault(about=about, kind="health", text=text)))


def greet_next(live: Live) -> None:
    """Wait until one more has subscribed, and greet it."""
    wait_until(lambda: not live._newcomers._queue.empty())
    live.greet()


def has_viewer(live: Live, topic: str) -> bool:
    return live._channels[topic][1].has_sinks()


def test_a_viewer_gets_what_it_subscribed_to_as_the_schema_says(live: Live) -> None:
    live.write(joints(1))
    live.write(fault("hot"))
    with viewer(live.url) as looking:
        assert looking.info["name"] == "TRADE system lab"
        looking.subscribe("/rosie.head/joints")
        wait_until(lambda: has_viewer(live, "/rosie.head/joints"))
        live.write(fault("hotter"))  # which it did not subscribe to
        live.write(joints(123_456_789_000, 0.25))
        topic, at_ns, value = looking.message()
        assert (topic, at_ns, value["position_rad"]) == ("/rosie.head/joints", 123_456_789_000, [0.25])
        assert looking.channels[topic]["schemaName"] == "trade.JointStates"


def test_nothing_comes_in_from_a_viewer(live: Live) -> None:
    with viewer(live.url) as looking:
        assert looking.info["capabilities"] == []
        for asked in (
            {"op": "advertise", "channels": [{"id": 1, "topic": "/a", "encoding": "json", "schemaName": "b"}]},
            {"op": "setParameters", "parameters": [{"name": "a", "value": 1}]},
            {"op": "getParameters", "parameterNames": []},
        ):
            looking.send(asked)
            while (said := looking.hear())["op"] == "advertise":
                pass
            assert (said["op"], said["level"]) == ("status", 2)
            assert "does not support" in said["message"]


def test_a_viewer_with_another_protocol_is_rejected_and_reported(live: Live) -> None:
    with pytest.raises(InvalidStatus):
        connect(live.url, subprotocols=[Subprotocol("foxglove.websocket.v1")]).__enter__()
    said: list[str] = []
    wait_until(lambda: said.extend(live.notices()) or any("handshake failed" in line for line in said))


def test_a_late_page_gets_the_current_locks_and_faults_and_no_other_page_does(live: Live) -> None:
    live.write(Message(LOCKS, 3, 3, encoded(Locks(locks=[]))))
    for message in (fault("hot"), fault("silent", "rosie.tail"), fault("")):
        live.write(message)
    with viewer(live.url) as first, viewer(live.url) as second:
        for looking in (first, second):
            looking.subscribe("/faults")
            greet_next(live)
            _, at_ns, reported = looking.message()
            assert (at_ns, reported["about"], reported["text"]) == (7, "rosie.tail", "silent")
        second.subscribe("/locks")
        greet_next(live)
        assert second.message()[0] == "/locks"
        live.write(fault("", "rosie.tail"))
        assert first.message()[2]["text"] == ""


def test_a_topic_whose_schema_has_changed_is_offered_again(live: Live) -> None:
    live.write(picture("rosie.eye", b"abc", "png", 1, 1, 5))
    with viewer(live.url) as looking:
        looking.subscribe("/cameras/rosie.eye")
        before = looking.channels["/cameras/rosie.eye"]["id"]
        wait_until(lambda: has_viewer(live, "/cameras/rosie.eye"))
        raw = picture("rosie.eye", b"abc", "rgb8", 1, 1, 6)
        live.write(raw)
        while looking.channels["/cameras/rosie.eye"]["id"] == before:
            looking.hear()
        assert looking.withdrawn == [before]
        looking.subscribe("/cameras/rosie.eye")
        wait_until(lambda: has_viewer(live, "/cameras/rosie.eye"))
        live.write(raw)
        assert looking.message()[2]["encoding"] == "rgb8"


def test_a_viewer_that_does_not_read_misses_messages_and_delays_no_other(live: Live) -> None:
    many, large = (
        400,
        Message(Channel("/large", "Large", b'{"type": "object"}'), 0, 0, b'{"a": "%s"}' % (b"x" * 500_000)),
    )
    live.write(large)
    live.write(joints(0))
    with viewer(live.url, max_queue=1) as slow, viewer(live.url) as quick:
        slow.subscribe("/large")
        quick.subscribe("/rosie.head/joints")
        wait_until(lambda: has_viewer(live, "/large") and has_viewer(live, "/rosie.head/joints"))
        for number in range(1, many + 1):  # 200 MB, much more than sockets hold
            live.write(large._replace(arrived_ns=number))
            live.write(joints(number))
            assert quick.message()[1] == number
        seen = [slow.message()[1]]
        while seen[-1] < many:
            seen.append(slow.message()[1])
        assert seen == sorted(seen)
        assert len(seen) < many
    assert live.behind >= 1
    assert any("too slow and misses messages" in line for line in live.notices())


def test_a_port_that_is_in_use_is_reported(live: Live) -> None:
    port = int(live.url.rpartition(":")[2])
    with pytest.raises(ConfigurationError, match=f"127.0.0.1:{port}: cannot be used: .*in use"):
        Live("127.0.0.1", port, "other")


def test_it_leaves_no_handler_of_logs_behind(live: Live) -> None:
    logger = logging.getLogger("foxglove")
    assert live._notices in logger.handlers
    live.close()
    live.close()
    assert live._notices not in logger.handlers


def test_without_its_library_the_command_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    done = CliRunner().invoke(app, ["foxglove"])
    assert 'needs foxglove. Run `pip install "trade-gateway[foxglove]"`' in str(done.exception)
