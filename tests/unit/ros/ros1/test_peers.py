"""Which nodes are there: what the end of a connection means."""

import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow

PROGRAM = """
import socket, sys, threading, time
from trade_gateway.ros.ros1._node._peers import Peers
reported, closed = [], []
server = socket.create_server(("127.0.0.1", 0))
def serve():
    while len(closed) < 4:
        came, _ = server.accept()
        came.close()
        closed.append(time.monotonic())
    kept, _ = server.accept()
    server.close()
    kept.close()
threading.Thread(target=serve, daemon=True).start()
peers = Peers(lambda name, there: reported.append((name, there)))
uri = "http://127.0.0.1:%d/" % server.getsockname()[1]
peers.at("/arm", uri)
deadline = time.monotonic() + 60
while len(reported) < 2 and time.monotonic() < deadline:
    time.sleep(0.01)
print(reported, len(closed), peers.uri("/arm"), flush=True)
"""

BESIDE_STALE = """
import os, socket, threading, time
from trade_gateway.ros.ros1._node._peers import Peers
reported, asked, never = [], [], threading.Event()
real = socket.getaddrinfo
def look_up(host, *rest, **named):
    if host != "127.0.0.1" and reported:
        asked.append(host)
        never.wait()
    return real("127.0.0.1" if host == "arm.example" else host, *rest, **named)
socket.getaddrinfo = look_up
server = socket.create_server(("127.0.0.1", 0))
peers = Peers(lambda name, there: reported.append((name, there)))
deadline = time.monotonic() + 60
def wait(true):
    while not true() and time.monotonic() < deadline:
        time.sleep(0.01)
peers.at("/arm", "http://arm.example:%d/" % server.getsockname()[1])
wait(lambda: reported)
for number in range(100):
    peers.at("/stale%d" % number, "http://stale%d.example:1/" % number)
wait(lambda: len(asked) >= 8)
kept, _ = server.accept()
server.close()
kept.close()
wait(lambda: len(reported) > 1)
print(reported, flush=True)
os._exit(0)
"""


def test_a_node_that_closes_idle_connections_is_present_until_it_stops_listening() -> None:
    ran = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=100, check=True)
    assert ran.stdout.strip() == "[('/arm', True), ('/arm', False)] 4 None"


def test_a_death_is_reported_despite_many_stale_nodes_and_without_name_lookup() -> None:
    ran = subprocess.run([sys.executable, "-c", BESIDE_STALE], capture_output=True, text=True, timeout=100, check=True)
    assert ran.stdout.strip() == "[('/arm', True), ('/arm', False)]"
