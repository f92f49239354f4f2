"""``trade ros``: what it says, and that it ends in order."""

import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.waiting import PATIENCE_S, wait_until
from trade import Container, Settings, where

pytestmark = pytest.mark.slow

EXAMPLE = Path(__file__).parents[3] / "examples" / "ros.toml"
ROOT = Path(__file__).parents[3]
STARTED = """
import sys, types
sys.path.insert(0, {root!r})
from tests.unit.ros.memory_graph import MemoryRos
module = types.ModuleType("trade_gateway.ros.ros2")
def Ros2(*, router="", domain_id=0, node, folders):
    print("as", node, domain_id, file=sys.stderr, flush=True)
    return MemoryRos(2, folders).graph(node)
module.Ros2 = Ros2
sys.modules[module.__name__] = module
sys.argv = ["trade", *{words!r}]
from trade_gateway.cli import main
main()
"""


def trade(*words: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [sys.executable, "-m", "trade_gateway", *words], capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )


def test_check_says_what_a_file_maps_and_joins_nothing() -> None:
    ended = trade("ros", str(EXAMPLE), "--check")
    assert ended.returncode == 0, ended.stderr
    assert "joints of rosie.head as action /head_controller/follow_joint_trajectory" in ended.stdout
    reported = json.loads(trade("ros", str(EXAMPLE), "--check", "--json").stdout)
    assert len(reported["maps"]) == 11


def test_a_wrong_file_is_one_line_and_exit_code_1(tmp_path: Path) -> None:
    path = tmp_path / "ros.toml"
    path.write_text("[ros]\nversion = 2\nrooter = 1\n")
    ended = trade("ros", str(path))
    assert (ended.returncode, ended.stdout) == (1, "")
    assert "ros.rooter: unknown key" in ended.stderr


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_it_says_what_is_mapped_and_ends_cleanly(system: str, number: signal.Signals) -> None:
    words = ["ros", str(EXAMPLE)]
    process = subprocess.Popen(
        [sys.executable, "-c", STARTED.format(root=str(ROOT), words=words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        lines: list[str] = []
        wait_until(lambda: lines.append(line := process.stdout.readline()) or "bridged" in line or not line)
        assert any("topic /battery_voltage is in base.battery" in line for line in lines), lines
        with Container(Settings.read(container="looks-on")) as container:
            handle = container.find(where(name="bridged", group="ros"), wait_s=PATIENCE_S)
            assert list(handle().from_ros["topic /cmd_vel"]) == ["base"]
        process.send_signal(number)
        out, errors = process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
        process.communicate()
    assert process.returncode == 0, errors
    assert out.endswith("leaving\n")
    assert "as /trade 0" in errors
    assert "there is no policy" in errors
