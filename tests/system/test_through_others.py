"""Commands that reach another container than the robot's: what they say, and that their stops get there (S07)."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.support.waiting import wait_until
from tests.system.conftest import ROSIES_HEAD, Bench, Program
from tests.system.networks import PATIENCE_S, Member, Networks

NEWCOMER = Path(__file__).with_name("newcomer.py")
ROBOT, BASE, OUTSIDE = "10.232.1.1:7450", "10.232.1.2:7450", "10.232.2.2:7450"
DEAD = [f"tcp/10.232.{net}.{last}:7450" for net in (1, 2) for last in range(100, 105)]
TURNS = 10
pytestmark = [pytest.mark.realtime, pytest.mark.timeout(300)]


class Visitor:
    """Commands on a host that reaches ``base`` and not ``rosie``, which ``base`` is linked to."""

    def __init__(self, networks: Networks, folder: Path, system: str) -> None:
        networks.lay("inside", left="10.232.1.1", mid="10.232.1.2")
        networks.lay("outside", mid="10.232.2.2", right="10.232.2.3")
        self._host = networks.host("right")
        self.robot = Member(networks.host("left"), "rosie", ROBOT, folder)
        self.base = Member(networks.host("mid"), "base", f"{BASE},{OUTSIDE}", folder)
        self.robot.ask("start")
        self.robot.ask("register_joint", "rosie.neck")
        self.base.ask("start", f"tcp/{ROBOT}")
        self.base.ask("group", "rosie", "rosie")
        self._environment = {
            **os.environ,
            "TRADE_CREDENTIALS": "lab:secret",
            "TRADE_INSECURE_LAN": "1",
            "TRADE_SYSTEM": f"{system}-0",
            "TRADE_RUNTIME_DIR": str(folder / "right"),
            "TRADE_STATE_DIR": str(folder / "right" / "state"),
        }

    def _run(self, words: list[str], connect: list[str]) -> "subprocess.CompletedProcess[str]":
        return subprocess.run(
            ["ip", "netns", "exec", self._host, sys.executable, *words],
            env={**self._environment, "TRADE_CONNECT": ",".join(connect)},
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )

    def trade(self, *words: str) -> "subprocess.CompletedProcess[str]":
        return self._run(["-m", "trade_gateway", *words], [f"tcp/{OUTSIDE}"])

    def stop(self, *connect: str) -> tuple[bool, float, str]:
        """Whether a new container's stop of the group is confirmed, in how many seconds, and its report."""
        said = self._run([str(NEWCOMER), "rosie", "3"], list(connect))
        assert said.returncode == 0, said.stderr
        return json.loads(said.stdout)["stop"]


@pytest.fixture
def visitor(networks: Networks, tmp_path: Path, system: str) -> Iterator[Visitor]:
    made = Visitor(networks, tmp_path, system)
    yield made
    made.base.close()
    made.robot.close()


def test_S07_a_command_says_who_sees_the_robot_and_stops_it_through_them(visitor: Visitor) -> None:
    for words in (["services"], ["containers"], ["doctor"], ["call", "rosie.neck.echo", "3"]):
        said = visitor.trade(*words)
        assert "base sees rosie (" in said.stdout + said.stderr, words
        assert "no link from here yet" in said.stdout + said.stderr, words
        assert "password" not in said.stdout + said.stderr, words
    said = visitor.trade("stop", "rosie")
    assert (said.returncode, said.stdout) == (0, "stopped: rosie.neck.halt\n"), said.stderr
    said = visitor.trade("stop", "marvin", "--limit", "1")
    assert said.returncode == 1
    assert "base sees rosie (" in said.stderr


def test_S07_dead_addresses_do_not_delay_a_stop(visitor: Visitor) -> None:
    """Ten dead addresses before the good one, ten times in a row."""
    took: list[float] = []
    for _ in range(TURNS):
        complete, took_s, report = visitor.stop(*DEAD, f"tcp/{OUTSIDE}")
        assert complete, report
        assert "rosie.neck.halt" in report
        took.append(took_s)
    assert sorted(took)[TURNS // 2] < 1.0, took


STOP = """
import json, time
from trade import Container, Settings
settings = Settings.read(container="visitor")
began = time.monotonic()
with Container(settings) as container:
    report = container.stop("rosie", "a test", limit_s=4)
    took_s = time.monotonic() - began
print(json.dumps([report.complete, took_s, list(report.stopped), report.failed]))
"""
MOVE = ["call", "--deadline", "60", "rosie.head.move_to"]
HUB = f"tcp/{ROBOT}"


class Hosts:
    """Programs on two hosts: a robot that is attached to the hub of its host, and people who dial that."""

    def __init__(self, networks: Networks, folder: Path, patch: pytest.MonkeyPatch) -> None:
        networks.lay("lan", left="10.232.1.1", right="10.232.1.3")
        self.networks, self._folder, self._patch = networks, folder, patch
        for name, value in (("CREDENTIALS", "lab:secret"), ("INSECURE_LAN", "1")):
            patch.setenv(f"TRADE_{name}", value)

    def at(self, host: str, listen: str = "", connect: str = "") -> str:
        """Programs that start from now on are on this host, and use these endpoints; returns its namespace."""
        folder = self._folder / host
        for name, value in (
            ("RUNTIME_DIR", str(folder)),
            ("STATE_DIR", str(folder / "state")),
            ("LISTEN", listen),
            ("CONNECT", connect),
        ):
            if value:
                self._patch.setenv(f"TRADE_{name}", value)
            else:
                self._patch.delenv(f"TRADE_{name}", raising=False)
        return self.networks.host(host)


def test_S07_a_robot_that_moves_stops_in_a_second_whatever_addresses_are_dead(
    networks: Networks,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    benches: Callable[..., Bench],
    run: Callable[..., Program],
) -> None:
    """Ten dead addresses before that of a hub, ten times in a row; a call is answered within 5 s."""
    hosts = Hosts(networks, tmp_path, monkeypatch)
    run("-m", "trade_gateway", "hub", inside=hosts.at("left", listen=HUB)).line()
    bench = benches(ROSIES_HEAD, inside=hosts.at("left"))
    host = hosts.at("right", connect=",".join([*DEAD, HUB]))

    def trade(*words: str) -> tuple[list[str], float]:
        began, program = time.monotonic(), run("-m", "trade_gateway", *words, inside=host)
        lines = program.lines()
        assert program.wait() == 0, program.errors
        return lines, time.monotonic() - began

    took: list[float] = []
    for turn in range(TURNS):
        goal = 1.0 if turn % 2 == 0 else -1.0
        moving = run("-m", "trade_gateway", *MOVE, f"[{goal}, 0.0]", "speed_rad_s=0.1", inside=host)
        wait_until(bench.moving, "it moves")
        since = time.monotonic()
        complete, took_s, stopped, failed = json.loads(run("-c", STOP, inside=host).line())
        assert (complete, failed) == (True, {}), (stopped, failed)
        assert not bench.moving()
        assert abs(bench.rests("neck.pan", since)[-1]) < 0.9
        took.append(took_s)
        assert moving.wait() != 0
        assert trade("call", "rosie.head.state", "--json")[1] < 5.0
        trade("resume", "rosie.neck")
    assert max(took) < 1.0, took
