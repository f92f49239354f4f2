"""Commands that reach another container than the robot's: what they say, and that their stops get there (S07)."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.system.networks import PATIENCE_S, Member, Networks

NEWCOMER = Path(__file__).with_name("newcomer.py")
ROBOT, BASE, OUTSIDE = "10.232.1.1:7450", "10.232.1.2:7450", "10.232.2.2:7450"
DEAD = [f"tcp/10.232.2.{last}:7450" for last in range(100, 110)]
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
