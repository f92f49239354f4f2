"""A whole system from one file: rosie, her ROS bridge, a behaviour, a recorder, and a container in another language."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

import trade
from tests.support.ros1_system import Stand, need_ros1
from tests.support.ros2_processes import free_port
from tests.support.rust_peer import built_peer
from tests.support.waiting import wait_until
from tests.system.conftest import ROSIES_HEAD, patient_copy
from trade import where
from trade.errors import TradeError

pytestmark = [pytest.mark.timeout(1800)]  # the container in Rust may have to be built first

BEHAVIOUR = """
import sys, time
import trade
from trade import service, where

class Looks:
    @service(effect="read")
    def looked(self) -> float:
        return trade.find(where(name="state", group="rosie.neck.pan"), wait_s=5)().position_rad

trade.register(Looks(), "behaviour")
time.sleep(3600)
"""
SYSTEM = """
[system]
name = "{system}"
supervisor = "keeper"

[container.rosie]
robot = "head.toml"
sim = true
listen = ["{endpoint}"]

[container.ros]
ros = "ros.toml"
after = ["rosie"]

[container.behaviour]
program = ["{python}", "behaviour.py"]
announces = "behaviour"
after = ["rosie"]

[container.recorder]
record = {{ folder = "recordings", groups = ["rosie"] }}
after = ["rosie"]

[container.arm]
program = ["{peer}"]
announces = "arm"
connect = ["{endpoint}"]
env = {{ TRADE_STATE_DIR = "{folder}/state" }}
after = ["rosie"]
"""
ROS = """
[ros]
version = 1
master = "{master}"

[[to_ros.lock]]
group = "rosie.neck.pan"
"""
NAMES = ["rosie", "ros", "behaviour", "recorder", "arm"]

Command = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def master(tmp_path: Path) -> Iterator[Stand]:
    need_ros1()
    stand = Stand(tmp_path / "home")
    stand.start_master()
    yield stand
    stand.close()


class Judge:
    """What each container does, seen from outside of it and of its supervisor."""

    def __init__(self, folder: Path, master: Stand) -> None:
        self._folder = folder
        self._node = master.peer("owner")
        self._recorded: set[Path] = set()

    def rosie(self) -> bool:
        return isinstance(self._answer("state", group="rosie.neck.pan").position_rad, float)

    def ros(self) -> bool:
        before = len(self._node.all("called"))
        self._node.do("call", "/rosie/neck/pan/lock", "std_srvs/SetBool", {"data": True})
        wait_until(lambda: len(self._node.all("called")) > before, "the bridge answers or is absent")
        self._node.do("call", "/rosie/neck/pan/lock", "std_srvs/SetBool", {"data": False})
        wait_until(lambda: len(self._node.all("called")) > before + 1, "the bridge answers or is absent")
        return bool(self._node.all("called")[-2]["success"])

    def behaviour(self) -> bool:
        return isinstance(self._answer("looked", container="behaviour"), float)

    def recorder(self) -> bool:
        """A file that was not there before the last time has samples."""
        fresh = {path for path in (self._folder / "recordings").iterdir() if path.stat().st_size > 2000}
        found = bool(fresh - self._recorded)
        self._recorded |= fresh
        return found

    def arm(self) -> bool:
        return bool(self._answer("echo", "hello", group="peer") == "hello")

    @staticmethod
    def _answer(name: str, *args: object, **selected: str) -> Any:
        return trade.find(where(name=name, **selected), wait_s=1).with_(deadline_s=2)(*args)

    def works(self, name: str) -> bool:
        try:
            return bool(getattr(self, name)())
        except (TradeError, AttributeError):
            return False


@pytest.fixture
def file(system: str, tmp_path: Path, master: Stand, trade_command: Command) -> Iterator[Path]:
    peer = built_peer()
    patient_copy(ROSIES_HEAD, tmp_path)
    (tmp_path / "recordings").mkdir()
    (tmp_path / "behaviour.py").write_text(BEHAVIOUR)
    (tmp_path / "ros.toml").write_text(ROS.format(master=master.uri))
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    file = tmp_path / "system.toml"
    places = {"python": sys.executable, "peer": peer, "folder": tmp_path}
    file.write_text(SYSTEM.format(system=system, endpoint=endpoint, **places))
    yield file
    trade_command("system", "down", file, "--force")


def test_one_file_brings_up_all_kinds_and_each_is_back_after_kill_9(
    file: Path, tmp_path: Path, master: Stand, trade_command: Command
) -> None:
    ended = trade_command("system", "up", file, "--json")
    assert ended.returncode == 0, ended.stderr
    reported = [json.loads(line) for line in ended.stdout.splitlines()]
    started = [one["container"] for one in reported if one["state"] == "started"]
    assert started[:2] == ["keeper", "rosie"]
    assert sorted(started) == sorted(["keeper", *NAMES])

    judge = Judge(tmp_path, master)
    for name in NAMES:
        wait_until(lambda name=name: judge.works(name), f"{name} works")
    pids = {one["container"]: one["pid"] for one in reported if one["state"] == "started"}
    for name in NAMES:
        os.kill(pids[name], signal.SIGKILL)
        wait_until(lambda name=name: not _runs(pids[name]), f"{name} is dead")
    for name in NAMES:
        wait_until(lambda name=name: judge.works(name), f"{name} works again")

    same = trade_command("system", "diff", file)
    assert (same.returncode, same.stdout) == (0, f"{file} describes what runs\n"), same.stderr
    taken = tmp_path / "elsewhere" / "now.toml"
    taken.parent.mkdir()
    written = trade_command("--system", _system(file), "system", "snapshot", taken)
    assert written.returncode == 0, written.stderr
    again = trade_command("system", "diff", taken)
    assert again.returncode == 0, again.stdout
    upped = trade_command("system", "up", taken, "--json")
    assert {json.loads(line)["state"] for line in upped.stdout.splitlines()} == {"was up"}, upped.stderr

    down = trade_command("system", "down", file, "--json")
    order = [json.loads(line)["container"] for line in down.stdout.splitlines()]
    assert order[-2:] == ["rosie", "keeper"], down.stderr
    wait_until(lambda: not any(_system(file) in " ".join(_words(one)) for one in psutil.process_iter()))


def _system(file: Path) -> str:
    return file.read_text().split('name = "')[1].split('"')[0]


def _runs(pid: int) -> bool:
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def _words(process: psutil.Process) -> list[str]:
    try:
        return process.cmdline()
    except psutil.Error:
        return []
