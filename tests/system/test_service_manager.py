"""Commands as services of systemd: what they tell it while they come up, run, read their file again and leave."""

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

import trade
from tests.support.waiting import wait_until
from tests.system.conftest import ROSIES_HEAD, at_ports
from trade import where
from trade_hil_sim import SimProcess, events

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
FILE = """
system = "{system}"
credentials = "lab:secret"
insecure_lan = true
connect = ["tcp/127.0.0.1:1"]

[network.here]
interface = "lo"
listen = ["tcp/127.0.0.1:{port}"]
"""


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[socket.socket]:
    """Where systemd listens."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as opened:
        opened.settimeout(60)
        opened.bind(str(tmp_path / "notify"))
        yield opened


@pytest.fixture
def file(system: str, tmp_path: Path) -> Path:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    made = tmp_path / "gateway.toml"
    made.write_text(FILE.format(system=system, port=port))
    return made


@pytest.fixture
def sim() -> Iterator[SimProcess]:
    with SimProcess(ROSIES_HEAD) as started:
        yield started


class Service:
    """A command, started as systemd starts it."""

    def __init__(self, manager: socket.socket, *words: str) -> None:
        self._manager = manager
        asked = {"NOTIFY_SOCKET": manager.getsockname(), "WATCHDOG_USEC": "30000000"}
        self.process = subprocess.Popen(
            [sys.executable, "-m", "trade_gateway", *words],
            env={**os.environ, **asked},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    def children(self) -> list[psutil.Process]:
        """Those that run a program of their own by now."""
        return [one for one in psutil.Process(self.process.pid).children() if "mind" in one.cmdline()]

    def notification(self) -> dict[str, str]:
        lines = self._manager.recv(4096).decode().splitlines()
        return {name: value for name, _, value in (line.partition("=") for line in lines)}

    def next_but_alive(self) -> dict[str, str]:
        """Its next notification, besides that it is alive."""
        while (reported := self.notification()) == {"WATCHDOG": "1"}:
            pass
        return reported

    def leaves(self) -> None:
        self.process.send_signal(signal.SIGTERM)
        assert self.next_but_alive()["STOPPING"] == "1"
        assert self.process.wait(60) == 0

    def end(self) -> None:
        self.process.kill()
        self.process.wait(60)


def test_a_gateway_notifies_the_service_manager_reloads_its_file_and_shuts_down(
    manager: socket.socket, file: Path, system: str
) -> None:
    service = Service(manager, "gateway", str(file))
    try:
        first = service.notification()
        assert first["READY"] == "1"
        assert f"is up in system {system}" in first["STATUS"]
        assert [service.notification() for _ in range(2)] == [{"WATCHDOG": "1"}] * 2
        file.write_text(file.read_text().replace("system =", "sytem ="))
        assert service.next_but_alive()["RELOADING"] == "1"
        assert "continuing as before" in service.next_but_alive()["STATUS"]
        file.write_text(file.read_text().replace("sytem =", "system ="))
        assert service.next_but_alive()["RELOADING"] == "1"
        assert service.next_but_alive() == first
        service.leaves()
    finally:
        service.end()


def test_what_a_gateway_looks_after_does_not_speak_for_it(manager: socket.socket, file: Path) -> None:
    file.write_text(f"{file.read_text()}\n[container.mind]\nproviders = []\n")
    service = Service(manager, "gateway", str(file))
    try:
        assert service.notification()["READY"] == "1"
        wait_until(service.children, "its container is up")
        [mind] = service.children()
        asked = {"NOTIFY_SOCKET", "WATCHDOG_USEC"}
        assert asked < psutil.Process(service.process.pid).environ().keys()  # as it was started
        assert not asked & mind.environ().keys()
        service.leaves()
        assert not mind.is_running()
    finally:
        service.end()


def test_a_robot_notifies_the_service_manager_and_shuts_down(manager: socket.socket, system: str) -> None:
    service = Service(manager, "up", str(ROOT / "examples" / "head.toml"), "--sim")
    try:
        assert service.notification()["READY"] == "1"
        assert service.notification() == {"WATCHDOG": "1"}
        service.leaves()
    finally:
        service.end()


@pytest.mark.parametrize("leave", ["hold", "relax"])
def test_S19_a_service_that_is_stopped_leaves_its_robot_as_the_robot_file_says(
    manager: socket.socket, sim: SimProcess, system: str, tmp_path: Path, leave: str
) -> None:
    robot = at_ports(ROSIES_HEAD, sim, tmp_path)
    text = robot.read_text()
    assert text.count('leave = "hold"') == 1
    robot.write_text(text.replace('leave = "hold"', f'leave = "{leave}"'))
    file = tmp_path / "gateway.toml"
    file.write_text(f'system = "{system}"\n[container.head]\nrobot = "{robot}"\n')
    service = Service(manager, "gateway", str(file))
    try:
        assert service.notification()["READY"] == "1"
        pan = trade.find(where(name="move_to", group="rosie.neck.pan"), wait_s=60)
        pan.with_(deadline_s=120).start(1.0, 0.05)
        wait_until(lambda: events(sim.entries(), "motion_started", device_id=1))
        service.leaves()
    finally:
        service.end()
    [bus] = sim.control.state()
    truth = next(device for device in bus.devices if device.device_id == 1)
    assert (truth.torque, truth.moving) == (leave == "hold", False)
    assert truth.position_rad < 1.0
    assert not events(sim.entries(), "watchdog_expired")  # it was ordered to, before anything ran out
