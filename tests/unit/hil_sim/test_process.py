"""The simulator as a process of its own: ready line, clean end, and no life after its parent."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest
import serial

from tests.support.signals import signal_another_thread
from tests.support.waiting import wait_until
from trade_hil_sim import Command, SimProcess, SimulationError, events, instructions, read_log, remove_leftovers
from trade_hil_sim.__main__ import main
from trade_hil_sim.dynamixel import encode
from trade_hil_sim.faults._commands import kinds_of

pytestmark = pytest.mark.realtime

COMMAND = [sys.executable, "-m", "trade_hil_sim"]


def ping(port: str, device_id: int, baud: int = 1_000_000) -> bytes:
    with serial.Serial(port, baud, timeout=10) as line:
        line.write(encode(device_id, 1))
        return line.read(14)


def test_it_simulates_all_buses_of_a_robot_file(robot_file: Path) -> None:
    with SimProcess(robot_file) as sim:
        assert set(sim.ports) == {"neck", "arm"}
        assert ping(sim.ports["neck"], 1)[9:11] == (1060).to_bytes(2, "little")
        assert ping(sim.ports["arm"], 3, 57_600)[9:11] == (1020).to_bytes(2, "little")
        assert [(e.bus, e.name, e.device_id) for e in instructions(sim.entries())] == [
            ("neck", "ping", 1),
            ("arm", "ping", 3),
        ]
        sim.control.unplug("neck")
        assert not Path(sim.ports["neck"]).exists()
        ports, log = sim.ports, sim.log_path
    assert not any(Path(p).is_symlink() for p in [*ports.values(), str(log)])
    sim.close()


def test_what_it_logged_outlives_it_if_a_file_was_named(robot_file: Path, tmp_path: Path) -> None:
    with SimProcess(robot_file, log=tmp_path / "log", directory=tmp_path / "ports", buses=["neck"]) as sim:
        assert sim.ports == {"neck": str(tmp_path / "ports" / "neck")}
        ping(sim.ports["neck"], 2)
        sim.kill()
        # nothing is lost, not even to SIGKILL
        assert len(instructions(read_log(tmp_path / "log"), device_id=2)) == 1
    assert len(read_log(tmp_path / "log")) >= 3


def test_its_times_are_this_process_times(robot_file: Path) -> None:
    import time

    with SimProcess(robot_file, paced=False) as sim:
        before = time.monotonic()
        ping(sim.ports["neck"], 1)
        after = time.monotonic()
        assert len(instructions(sim.entries(), since=before, until=after)) == 1


def test_faults_come_in_while_it_runs(robot_file: Path) -> None:
    with SimProcess(robot_file) as sim:
        sim.control.brown_out([1])
        wait_until(lambda: events(sim.entries(), "booted", device_id=1), "the servo's return")
        assert sim.control.device("neck.pan").torque is False


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
@pytest.mark.parametrize("send", [os.kill, signal_another_thread])
def test_a_signal_ends_it_cleanly(
    robot_file: Path, tmp_path: Path, number: signal.Signals, send: Callable[[int, int], None]
) -> None:
    """One that another thread receives wakes no wait, nor does one that arrives just before the wait."""
    place = tmp_path / "d"
    with subprocess.Popen([*COMMAND, str(robot_file), "--dir", str(place)], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        ready = json.loads(process.stdout.readline())
        assert ready == {
            "ready": True,
            "ports": {"neck": str(place / "neck"), "arm": str(place / "arm")},
            "log": None,
            "control": str(place / "_control"),
        }
        assert sorted(p.name for p in place.iterdir()) == ["_control", "arm", "neck"]
        wait_until(lambda: psutil.Process(process.pid).status() == psutil.STATUS_SLEEPING, "it waits")
        send(process.pid, number)
        assert process.wait(20) == 0
    assert list(place.iterdir()) == []


def test_it_ends_when_its_parent_is_killed(robot_file: Path) -> None:
    code = """
import sys
from trade_hil_sim import SimProcess
sim = SimProcess(sys.argv[1])
print(sim.pid, sim.ports["neck"], flush=True)
sys.stdin.read()
"""
    command = [sys.executable, "-c", code, str(robot_file)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        pid, name = parent.stdout.readline().decode().split()
        child, port = psutil.Process(int(pid)), Path(name)
        assert port.is_symlink()
        parent.kill()
        wait_until(lambda: not child.is_running() or child.status() == psutil.STATUS_ZOMBIE, "the child's end")
        assert not port.is_symlink()
        shutil.rmtree(port.parent)


def test_it_ends_when_standard_input_does(robot_file: Path) -> None:
    command = [*COMMAND, str(robot_file), "--stdin"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdin is not None
        assert json.loads(process.stdout.readline())["ready"]
        process.stdin.write(b"words are ignored\n")
        process.stdin.close()
        assert process.wait(20) == 0


def test_a_robot_file_it_cannot_use_is_reported_on_standard_error(robot_file: Path, tmp_path: Path) -> None:
    with pytest.raises(SimulationError, match=r"nothere\.toml"):
        SimProcess(tmp_path / "nothere.toml")
    robot_file.write_text(robot_file.read_text().replace("XM430-W350", "AX-12A"))
    ended = subprocess.run([*COMMAND, str(robot_file)], capture_output=True, text=True, timeout=60, check=False)
    assert (ended.returncode, ended.stdout) == (2, "")
    assert ended.stderr.startswith("trade-hil-sim: ")
    assert ended.stderr.count("\n") == 1


def test_help_says_how_to_talk_to_it(robot_file: Path) -> None:
    said = subprocess.run([*COMMAND, "--help"], capture_output=True, text=True, timeout=60, check=True).stdout
    for word in ("--bus", "--log", "--control", "--unpaced", "--parent", "--stdin", '{"do": "mute", "ids": [1]}'):
        assert word in said


@pytest.mark.parametrize(
    ("words", "done"),
    [
        ("unplug bus=neck", ["unplugged"]),
        ("brown_out ids=1", ["brown_out"]),
        ("hardware_fault bits=0x20 ids=1 bus=neck", ["shutdown"]),
    ],
)
def test_one_that_runs_is_struck_by_a_command(robot_file: Path, words: str, done: list[str]) -> None:
    with SimProcess(robot_file) as sim:
        before = len(sim.entries())
        assert strike(str(sim.control_path), words) == (0, "", "")
        assert [one.name for one in sim.entries()[before:] if one.name in done] == done


def test_the_state_is_shown_by_a_command(robot_file: Path) -> None:
    with SimProcess(robot_file) as sim:
        assert strike(str(sim.control_path), "absent ids=1 on=false") == (0, "", "")
        code, said, _ = strike(str(sim.control_path), "state")
        assert (code, json.loads(said.splitlines()[0])["name"]) == (0, "neck")


def test_a_refusal_of_the_simulator_is_reported_in_one_line(robot_file: Path) -> None:
    with SimProcess(robot_file) as sim:
        for words, why in (
            ("jam ids=99", "no bus has a device [99]; there is [1, 2] on neck, [3] on arm"),
            ("jam ids=3 bus=neck", "bus neck has no device [3]; it has [1, 2]"),
            ("unplug bus=leg", "there is no bus 'leg'; there is neck, arm"),
        ):
            assert strike(str(sim.control_path), words) == (1, "", f"trade-hil-sim: {why}\n")


@pytest.mark.parametrize(
    ("words", "why"),
    [
        ("dance", "there is no fault 'dance'; there is absent, bad_crc"),
        ("jam ids=one", "jam: Expected `int`, got `str` - at `$.ids[0]`; its keys are bus, ids, on"),
        ("jam 4", "'4' is no KEY=VALUE, such as ids=1,2"),
        ("late", "late: Object missing required field `s`; its keys are bus, ids, instruction, skip, count, s"),
        ("garbage hex=xy", "garbage: non-hexadecimal"),
        ("hardware_fault bits=0xg", "hardware_fault: invalid literal"),
        ("jam id=4", "unknown field `id`; its keys are"),
        ("state bus=neck", "state: Object contains unknown field `bus`; it has no keys"),
        ("", "--do takes the control socket"),
    ],
)
def test_wrong_arguments_are_reported_in_one_line_before_anything_is_sent(
    words: str, why: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--do", "/nowhere/_control", *words.split()]) == 2
    said, problem = capsys.readouterr()
    assert (said, problem.count("\n")) == ("", 1)
    assert problem.startswith("trade-hil-sim: ")
    assert why in problem


def test_a_command_without_matching_service_says_where_it_searched(tmp_path: Path) -> None:
    code, _, problem = strike(str(tmp_path / "none"), "heal")
    assert (code, problem.count("\n")) == (1, 1)
    assert f"no simulator listens on {tmp_path / 'none'}" in problem


def strike(control: str, words: str) -> tuple[int, str, str]:
    """Exit code, output and errors of a command to a simulator that runs."""
    command = [*COMMAND, "--do", control, *words.split()]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    return ended.returncode, ended.stdout, ended.stderr


def test_help_lists_every_fault() -> None:
    said = subprocess.run([*COMMAND, "--help"], capture_output=True, text=True, timeout=60, check=True).stdout
    for word, kind in kinds_of(Command).items():
        [line] = re.findall(rf"^  {word} .*", said, re.MULTILINE)
        assert all(key in line for key in kind.__struct_fields__ if key != "bus")


def test_the_package_alone_imports_none_of_our_other_packages() -> None:
    code = "import trade_hil_sim, sys; print(sorted({'trade', 'trade_drivers', 'zenoh'} & set(sys.modules)))"
    command = [sys.executable, "-W", "error", "-c", code]
    assert subprocess.run(command, capture_output=True, timeout=60, check=True).stdout == b"[]\n"


@pytest.fixture
def short() -> Iterator[Path]:
    """A folder whose path leaves room for a socket's, which may have 107 characters."""
    with tempfile.TemporaryDirectory(prefix="short-") as folder:
        yield Path(folder)


def test_only_folders_of_its_kind_whose_owner_is_gone_are_removed(
    robot_file: Path, short: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(short))
    for name in ("trade-sim-dead", "trade-sim-stranger", "trade-demo-dead"):
        (short / name).mkdir()
    for name in ("trade-sim-dead", "trade-demo-dead"):
        (short / name / "_owner.pid").write_text("4711")
    with SimProcess(robot_file) as alive:
        assert remove_leftovers() == [short / "trade-sim-dead"]
        left = sorted(path.name for path in short.iterdir())
        assert left == sorted(["trade-demo-dead", "trade-sim-stranger", alive.control_path.parent.name])
        assert ping(alive.ports["neck"], 1)
