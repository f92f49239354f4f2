"""A driver and its simulator in a package of their own, found by nothing but their entry points."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from importlib import invalidate_caches
from pathlib import Path
from typing import Any

import pytest

from tests.support.waiting import wait_until
from trade.errors import ConfigurationError, DeviceSilent
from trade_drivers import AttachedRobot, Sensor, attach, drivers, load
from trade_drivers.testing import SensorContract
from trade_hil_sim import ByteLog, Heal, Late, Mute, Replug, SimProcess, SimulationError, Supply, Truncate, Unplug
from trade_hil_sim.robot._robot import buses_of

pytestmark = pytest.mark.realtime

PLUGIN = Path(__file__).parents[3] / "examples" / "plugin"
OVEN = PLUGIN / "oven.toml"
MOST_LINES = 60


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The package as pip leaves it, for this process and those that it starts: its modules and its entry points."""
    text = (PLUGIN / "pyproject.toml").read_text()
    sections = re.findall(r'\[project\.entry-points\."([\w.]+)"\]\n((?:[\w-]+ = .*\n)+)', text)
    assert [name for name, _ in sections] == ["trade.drivers", "trade.sims"]
    about = tmp_path / "acme_thermo-0.1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: acme-thermo\nVersion: 0.1.0\n")
    (about / "entry_points.txt").write_text("".join(f"[{name}]\n{body}\n".replace('"', "") for name, body in sections))
    for path in (tmp_path, PLUGIN / "src"):
        monkeypatch.syspath_prepend(path)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), str(PLUGIN / "src")]))
    invalidate_caches()


class Oven:
    """The plug-in's robot on the plug-in's simulator, in this process."""

    def __init__(self, folder: Path, undo: ExitStack) -> None:
        self.log = ByteLog()
        [self.sim] = buses_of(load(OVEN), folder, log=self.log)
        undo.callback(self.sim.close)
        self.sim.open()
        self._undo = undo

    def attach(self) -> AttachedRobot:
        ports = {self.sim.name: str(self.sim.port)}
        return self._undo.enter_context(attach(load(OVEN), announced=False, ports=ports))


@pytest.fixture
def oven(installed: None, tmp_path: Path) -> Iterator[Oven]:
    with ExitStack() as undo:
        (tmp_path / "ports").mkdir()
        yield Oven(tmp_path / "ports", undo)


@pytest.fixture
def sensor(oven: Oven) -> Sensor:
    return oven.attach().sensor("oven.temperature")


class TestThermo(SensorContract):
    @pytest.fixture
    def sensor(self, oven: Oven) -> Sensor:
        return oven.attach().sensor("oven.temperature")


def test_the_driver_is_found_by_its_entry_point_alone(installed: None) -> None:
    [point] = drivers()["acme-thermo"]
    assert point.value == "acme_thermo.driver:ThermoDriver"
    assert point.dist is not None
    assert point.dist.name == "acme-thermo"


def test_without_the_package_the_robot_file_says_what_is_missing() -> None:
    with pytest.raises(ConfigurationError, match=r"oven\.temperature\"\.driver: there is no driver 'acme-thermo'"):
        attach(load(OVEN))


def test_the_driver_is_short(installed: None) -> None:
    lines = (PLUGIN / "src" / "acme_thermo" / "driver.py").read_text().splitlines()
    assert len(lines) <= MOST_LINES


def test_the_example_on_the_page_is_the_driver() -> None:
    page = (PLUGIN.parents[1] / "docs" / "drivers.md").read_text()
    driver = (PLUGIN / "src" / "acme_thermo" / "driver.py").read_text()
    [shown] = re.findall(r"```python\n(class Thermo\(.*?)```", page, re.DOTALL)
    assert shown.strip() in driver


def test_attaching_reading_and_leaving_only_ask(oven: Oven) -> None:
    robot = oven.attach()
    robot.sensor("oven.temperature").read()
    robot.close()
    asked = b"".join(received.data for received in oven.log.entries if received.kind == "received")
    assert re.fullmatch(rb"(R[0-9]\n)+", asked)


def test_it_measures_what_its_probes_have(oven: Oven, sensor: Sensor) -> None:
    assert sensor.read().value == [21.5, 21.5]
    oven.sim.do(Supply(temperature_c=180))
    wait_until(lambda: sensor.read().value == [180.0, 180.0], "it got hot")
    assert sensor.read().quality == "good"
    sim: Any = oven.sim
    sim.celsius[1] = 500.0
    wait_until(lambda: sensor.read().quality == "doubtful", "a probe is beyond its range")


@pytest.mark.parametrize(
    ("fault", "over"),
    [(Mute(), Heal()), (Late(s=0.35), Heal()), (Truncate(missing=4), Heal()), (Unplug(), Replug())],
    ids=["mute", "late", "truncated", "unplugged"],
)
def test_what_goes_wrong_on_its_line_is_silence_and_never_a_number(
    oven: Oven, sensor: Sensor, fault: Any, over: Any
) -> None:
    oven.sim.do(fault)
    wait_until(lambda: _is_silent(sensor), "its last reading is too old")
    oven.sim.do(over)
    wait_until(lambda: not _is_silent(sensor), "it is back by itself")


def test_a_file_that_says_another_number_of_probes_is_refused(oven: Oven, tmp_path: Path) -> None:
    file = tmp_path / "oven.toml"
    file.write_text(OVEN.read_text().replace("probes = 2", "probes = 3"))
    with pytest.raises(ConfigurationError, match=r"temperature\"\.port: .*it has 2 probes; the robot file says 3"):
        attach(load(file), ports={oven.sim.name: str(oven.sim.port)})
    file.write_text(OVEN.read_text().replace("probes = 2", "probes = 5"))
    with pytest.raises(SimulationError, match="a TC-4 has 1 to 4, not 5"):
        buses_of(load(file), tmp_path)


def test_the_contract_runs_on_it_as_on_hardware_and_prompts_nothing(installed: None, system: str) -> None:
    with SimProcess(OVEN) as sim:
        [(name, port)] = sim.ports.items()
        command = [sys.executable, "-m", "trade_drivers.testing", "--hil", str(OVEN), f"--port={name}={port}"]
        ended = subprocess.run(command, input="", capture_output=True, text=True, timeout=100, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert "test_readings_can_be_streamed[kitchen.oven.temperature] PASSED" in ended.stdout


def _is_silent(sensor: Sensor) -> bool:
    try:
        sensor.read()
    except DeviceSilent:
        return True
    return False
