"""The middleware's own functions across processes: empty containers, what is made in them, their end."""

import json
import signal
import socket
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import trade
from tests.support.waiting import wait_until
from trade import where

Command = Callable[..., subprocess.CompletedProcess[str]]

CAMERA = """
import trade
from trade import service

class Camera:
    def __init__(self, width: int = 640) -> None:
        self.width = width

    @service(effect="read")
    def size(self) -> int:
        return self.width

class Looker:
    @service(effect="read")
    def home(self) -> tuple[str, str, int]:
        here = trade.container()
        return here.settings.system, here.name, len(trade.services(trade.where(name="home")))
"""
WITNESS = """
import trade
from trade_drivers import Measured, PolledSensor, SenseDriver, SensorInfo

class Witness(PolledSensor):
    def __init__(self, name):
        super().__init__(SensorInfo(name=name, model="W", unit="1", size=0, low=0.0, high=9.0, rate_hz=10.0), "none")

    def open(self): pass
    def hang_up(self): pass

    def measure(self):
        return Measured(float(len(trade.services(trade.where(name="read", container=trade.container().name)))), "good")

class WitnessDriver(SenseDriver):
    def attach(self, name, device, port):
        return Witness(name).start(name)
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


def test_what_is_made_in_a_container_finds_what_the_container_sees(
    run, vision: Path, system: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its system is known from the command line alone, and its port is fixed: a second container could not listen."""
    with socket.socket() as free, monkeypatch.context() as there:
        free.bind(("127.0.0.1", 0))
        there.setenv("TRADE_LISTEN", f"tcp/127.0.0.1:{free.getsockname()[1]}")
        there.delenv("TRADE_SYSTEM")
        eyes = run(
            "-m", "trade_gateway", "--system", system, "container", "--name", "eyes", "--allow", "sight.*", "--json"
        )
    assert eyes.json()["system"] == system
    function("instantiate", "eyes")("sight.vision:Looker", (), ["rosie.eyes"])
    assert trade.find(where(name="home"), wait_s=30)() == (system, "eyes", 1)
    assert len(trade.containers()) == 2


def test_a_driver_from_elsewhere_finds_what_the_robots_container_sees(
    run, tmp_path: Path, system: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    about = tmp_path / "witness-0.1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: witness\nVersion: 0.1.0\n")
    (about / "entry_points.txt").write_text("[trade.drivers]\nwitness = witness:WitnessDriver\n")
    (tmp_path / "witness.py").write_text(WITNESS)
    robot = tmp_path / "hall.toml"
    robot.write_text('[robot]\nname = "hall"\n[sensor.witness]\ndriver = "witness"\n')
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with monkeypatch.context() as there:
        there.delenv("TRADE_SYSTEM")
        run("-m", "trade_gateway", "--system", system, "up", robot, "--json").json()
    read = trade.find(where(name="read", group="hall.witness"), wait_s=30)
    wait_until(lambda: read().value == 1.0, "it sees itself")


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
