"""Our node as a process: where it listens, and how it ends."""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import psutil
import pytest

from tests.support.ros1_system import Stand, our_node
from tests.support.waiting import PATIENCE_S, wait_until
from trade_gateway.ros._graph import RosUnreachable
from trade_gateway.ros.ros1 import Ros1, _child
from trade_gateway.ros.ros1._child import environment
from trade_gateway.ros.ros1._node import _heart
from trade_gateway.ros.ros1._node._frames import Channel, Head

LIVES = """
import sys, time
from trade_gateway.ros.ros1 import Ros1
graph = Ros1(sys.argv[1])
graph.serve("/lights", "std_srvs/srv/Trigger", lambda request, who, at: {})
while graph.healthy:
    time.sleep(0.01)
print("well", flush=True)
time.sleep(600)
"""


@pytest.mark.parametrize(
    ("master", "ip", "set_here", "becomes"),
    [
        ("http://localhost:11311", "", {}, {"ROS_IP": "127.0.0.1"}),
        ("http://127.0.0.1:11311", "", {}, {"ROS_IP": "127.0.0.1"}),
        ("http://10.0.0.2:11311", "", {}, {}),
        ("http://10.0.0.2:11311", "10.0.0.7", {"ROS_HOSTNAME": "arm"}, {"ROS_IP": "10.0.0.7"}),
        ("http://localhost:11311", "", {"ROS_HOSTNAME": "arm"}, {"ROS_HOSTNAME": "arm"}),
        ("http://localhost:11311", "", {"ROS_IP": "10.0.0.7"}, {"ROS_IP": "10.0.0.7"}),
    ],
)
def test_our_node_listens_on_loopback_if_the_master_does_unless_configured(
    master: str, ip: str, set_here: dict[str, str], becomes: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("ROS_IP", "ROS_HOSTNAME"):
        monkeypatch.delenv(name, raising=False)
    for name, value in set_here.items():
        monkeypatch.setenv(name, value)
    made = environment(master, ip)
    assert {name: made[name] for name in ("ROS_IP", "ROS_HOSTNAME") if name in made} == becomes
    assert made["ROS_MASTER_URI"] == master


@pytest.mark.slow
def test_our_node_ends_when_its_parent_is_killed(stand: Stand) -> None:
    parent = subprocess.Popen(
        [sys.executable, "-c", LIVES, stand.uri], stdout=subprocess.PIPE, env={**os.environ, "ROS_IP": "127.0.0.1"}
    )
    try:
        assert parent.stdout is not None
        assert parent.stdout.readline() == b"well\n"
        (node,) = psutil.Process(parent.pid).children()
    finally:
        parent.kill()
        parent.communicate(timeout=60)
    wait_until(lambda: not node.is_running() or node.status() == psutil.STATUS_ZOMBIE, "it ends")


@pytest.mark.slow
def test_a_signal_that_is_meant_for_us_does_not_end_our_node(graph: Ros1) -> None:
    graph.serve("/lights", "std_srvs/srv/Trigger", lambda request, who, at: {"success": True})
    node = our_node()
    for signal_ in (signal.SIGINT, signal.SIGTERM):
        node.send_signal(signal_)

    def answers() -> bool:
        with suppress(RosUnreachable):
            return graph.call("/lights", "std_srvs/srv/Trigger", {}, PATIENCE_S)["success"]
        return False

    wait_until(answers, "our node does its work")
    assert our_node() == node


@pytest.mark.slow
def test_our_node_is_killed_at_once_when_frozen_and_restarted(graph: Ros1) -> None:
    before = our_node()
    began = time.monotonic()
    before.send_signal(signal.SIGSTOP)
    wait_until(lambda: "froze" in graph.healthy, "it is reported")
    assert time.monotonic() - began < 12
    wait_until(lambda: not before.is_running(), "it is ended")
    wait_until(lambda: not graph.healthy, "all is well again")


def test_a_heart_beats_whatever_others_wait_for_until_no_work_is_done_at_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_heart, "_EVERY_S", 0.01)
    ours, theirs = socket.socketpair()
    heard: list[Head] = []
    with ours, theirs:
        channel, other = Channel(ours, "ours"), Channel(theirs, "theirs")
        reader = threading.Thread(target=other.read, args=(lambda head, body: heard.append(head),))
        reader.start()
        heart = _heart.Heart(channel)
        wait_until(lambda: len(heard) > 3, "it beats")
        assert {head["op"] for head in heard} == {"alive"}
        monkeypatch.setattr(_heart, "_STUCK_S", 0.0)
        heart.thread.join(PATIENCE_S)
        assert not heart.thread.is_alive()
        channel.close()
        other.close()
        reader.join(PATIENCE_S)


@pytest.mark.slow
def test_nothing_is_written_beside_the_program_of_our_node(stand: Stand, graph: Ros1) -> None:
    folder = Path(_child.__file__).parent / "_node"
    versions = {path.name.split(".")[1] for path in folder.glob("__pycache__/*.pyc")}
    assert versions <= {sys.implementation.cache_tag}


@pytest.mark.slow
def test_our_port_is_open_on_loopback_only(stand: Stand, graph: Ros1) -> None:
    graph.serve("/lights", "std_srvs/srv/Trigger", lambda request, who, at: {})
    listening = [at.laddr.ip for at in our_node().net_connections() if at.status == psutil.CONN_LISTEN]
    assert set(listening) == {"127.0.0.1"}
