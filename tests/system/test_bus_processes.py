"""Buses with a process of their own: one robot to its clients, and nothing of one process delays or ends another."""

import json
import os
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest

import trade
from tests.support.waiting import PATIENCE_S, wait_until
from tests.system.conftest import Bench, Program, at_ports
from trade import Handle, where
from trade_hil_sim import LogEntry, SimProcess, events, motion_writes

SIDES = ("left", "right")
ROBOT = """
[robot]
name = "rosie"
""" + "".join(
    f"""
[bus.{side}]
driver = "dynamixel"
port = "/dev/ttyNOWHERE{side}"
process = "{process}"
watchdog_s = 1

[joint."{side}.elbow"]
bus = "{side}"
id = 1
model = "XL430-W250"
min_rad = -1.4
max_rad = 1.4
max_speed_rad_s = 2.5
max_accel_rad_s2 = 20.0
"""
    for side, process in (("left", "own"), ("right", "shared"))
)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    made = tmp_path / "original" / "rosie.toml"
    made.parent.mkdir()
    made.write_text(ROBOT)
    return made


@pytest.fixture
def arms(file: Path, benches: Callable[..., Bench]) -> Bench:
    return benches(file)


def found(name: str, side: str) -> Handle:
    handle = trade.find(where(name=name, group=f"rosie.{side}.elbow"), wait_s=PATIENCE_S)
    return handle.with_(deadline_s=PATIENCE_S)


def process_of(bench: Bench) -> psutil.Process:
    """The process of the left bus."""
    [child] = [one for one in psutil.Process(bench.driver.process.pid).children() if "rosie-left" in one.cmdline()]
    return child


def set_off(bench: Bench, side: str) -> float:
    """Begin a slow move; when it began."""
    found("move_to", side).start(1.2, 0.1)
    wait_until(lambda: events(on(bench, side), "motion_started"), "it moves")
    return float(events(on(bench, side), "motion_started")[-1].t)


def on(bench: Bench, side: str) -> list[LogEntry]:
    return [entry for entry in bench.sim.entries() if entry.bus == side]


def test_each_bus_is_driven_by_its_process_and_the_robot_is_one(arms: Bench) -> None:
    homes = {side: trade.find(where(name="state", group=f"rosie.{side}.elbow"), wait_s=PATIENCE_S) for side in SIDES}
    assert {side: home.key.address.container for side, home in homes.items()} == {
        "left": "rosie-left",
        "right": "rosie",
    }
    with trade.lock(where(group="rosie"), wait_s=PATIENCE_S) as lock:
        assert sorted(lock.resources) == ["rosie.left.elbow", "rosie.right.elbow"]
        for side in SIDES:
            assert found("move_to", side)(0.3) == pytest.approx(0.3, abs=0.01)
    assert process_of(arms).pid != arms.driver.process.pid


def test_a_process_that_is_killed_ends_no_motion_but_its_own_and_is_back(arms: Bench) -> None:
    for side in SIDES:
        set_off(arms, side)
    killed = process_of(arms)
    killed.kill()
    wait_until(
        lambda: events(on(arms, "left"), "at_rest"), "its watchdog stops it, or the next process if that is sooner"
    )
    assert (events(on(arms, "left"), "at_rest")[0].position_rad or 0.0) < 1.19, "it stopped on its way"
    assert not events(on(arms, "right"), "at_rest")
    arms.driver.wait_for(lambda news: news.get("child") == "rosie-left" and "crashed" in news["text"])
    arms.driver.wait_for(lambda news: news.get("child") == "rosie-left" and "is back" in news["text"])
    assert not events(on(arms, "right"), "watchdog_expired")
    assert process_of(arms).pid != killed.pid
    found("enable", "left")()
    assert found("move_to", "left")(0.0) == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_the_end_of_the_robot_ends_all_its_processes_in_order(arms: Bench, number: int) -> None:
    for side in SIDES:
        set_off(arms, side)
    child = process_of(arms)
    os.kill(arms.driver.process.pid, number)
    assert arms.driver.wait() == 0
    assert not child.is_running()
    for side in SIDES:
        assert events(on(arms, side), "at_rest")
        assert not events(on(arms, side), "watchdog_expired")  # the driver stopped it


def test_a_robot_that_is_killed_leaves_no_process(arms: Bench) -> None:
    set_off(arms, "left")
    child = process_of(arms)
    arms.driver.signal(signal.SIGKILL)
    wait_until(lambda: not child.is_running(), "it ends")
    assert events(on(arms, "left"), "at_rest")
    assert not events(on(arms, "left"), "watchdog_expired")


def test_a_fault_of_a_process_of_its_own_is_reported_shown_and_acknowledged(
    arms: Bench, trade_command: Callable[..., subprocess.CompletedProcess[str]]
) -> None:
    arms.sim.control.mute(bus="left")
    report = arms.driver.wait_for(lambda news: news.get("joint") == "rosie.left.elbow")
    assert "did not answer" in report["fault"]
    [fault] = json.loads(trade_command("faults", "rosie", "--json").stdout)
    assert fault["device"] == "rosie.left.elbow"
    shown = trade_command("faults", "show", fault["id"])
    assert shown.returncode == 0, shown.stderr
    assert report["fault"][:30] in shown.stdout.replace("\n", " ")
    assert json.loads(trade_command("faults", "ack", fault["id"], "--json").stdout)["acknowledged_by"]
    arms.sim.control.heal(bus="left")
    assert arms.driver.wait_for(lambda news: news.get("joint") == "rosie.left.elbow")["fault"] == ""


def test_a_bus_that_cannot_be_attached_ends_the_start_with_its_reason_and_moves_nothing(
    file: Path, run: Callable[..., Program], tmp_path: Path, system: str
) -> None:
    with SimProcess(file) as sim:
        copy = at_ports(file, sim, tmp_path)
        copy.write_text(copy.read_text().replace('bus = "left"\nid = 1', 'bus = "left"\nid = 7'))
        up = run("-m", "trade_gateway", "up", copy, "--json")
        assert up.wait() == 75  # so that a gateway waits for it
        said = "".join(up.errors)
        assert "rosie-left" in said
        assert "id 7" in said
        assert not motion_writes(sim.entries())
