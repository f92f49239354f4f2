"""The middleware's own functions across processes: empty containers, what is made in them, their end."""

import json
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import trade
from trade import where

pytestmark = pytest.mark.slow

Command = Callable[..., subprocess.CompletedProcess[str]]

CAMERA = """
from trade import service

class Camera:
    def __init__(self, width: int = 640) -> None:
        self.width = width

    @service(effect="read")
    def size(self) -> int:
        return self.width
"""


@pytest.fixture
def vision(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the package ``sight``, importable in child processes."""
    folder = tmp_path / "packages"
    (folder / "sight").mkdir(parents=True)
    (folder / "sight" / "__init__.py").write_text("")
    (folder / "sight" / "vision.py").write_text(CAMERA)
    monkeypatch.setenv("PYTHONPATH", str(folder))
    return folder


def function(name: str, container: str) -> Any:
    return trade.find(where(name=name, group="trade", container=container), wait_s=30)


def test_an_empty_container_takes_providers_and_its_process_ends_on_request(run, vision: Path) -> None:
    eyes = run("-m", "trade_gateway", "container", "--name", "eyes", "--allow", "sight.*", "--json")
    ready = eyes.json()
    assert (ready["container"], ready["instantiable"]) == ("eyes", ["sight.*"])
    [size] = function("instantiate", "eyes")("sight.vision:Camera", {"width": 800}, ["rosie.eyes"])
    assert trade.find(where(name="size", group="rosie"), wait_s=30)() == 800
    assert size() == 800
    assert list(function("terminate_container", "eyes")("done")) == []
    assert eyes.wait() == 0
    assert "container eyes is terminated by" in "".join(eyes.errors)


def test_an_empty_container_leaves_on_sigterm(run) -> None:
    eyes = run("-m", "trade_gateway", "container", "--name", "eyes", "--json")
    eyes.json()
    eyes.signal(signal.SIGTERM)
    assert eyes.wait() == 0


def test_a_second_empty_container_of_one_name_does_not_come_up(run, trade_command: Command) -> None:
    run("-m", "trade_gateway", "container", "--name", "eyes", "--json").json()
    ended = trade_command("container", "--name", "eyes")
    assert ended.returncode == 1
    assert "'eyes' is up already" in ended.stderr


def test_a_robot_that_is_terminated_leaves_in_order(rosie_up, trade_command: Command) -> None:
    rosie = rosie_up()
    assert trade_command("call", "trade.terminate_container", '"home"', "--container", "rosie").returncode == 0
    assert rosie.program.wait() == 0


def test_containers_of_a_system_are_listed_with_what_was_made(run, vision: Path, trade_command: Command) -> None:
    run("-m", "trade_gateway", "container", "--name", "eyes", "--allow", "sight.vision:Camera", "--json").json()
    function("instantiate", "eyes")("sight.vision:Camera", (), ["rosie.eyes"])
    [listed] = json.loads(trade_command("services", "--group", "rosie", "--json").stdout)
    assert (listed["service"], listed["container"]) == ("rosie.eyes.size", "eyes")
