"""Whole systems of processes, as a user starts them."""

import json
import os
import queue
import re
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from tests.support.c_compiler import library
from tests.support.waiting import PATIENCE_S, wait_until
from tests.system.networks import Networks, why_not
from tests.system.sshd import Sshd, why_no_sshd
from tests.system.supervised import Keeping
from trade import Container
from trade_hil_sim import SimProcess, events, writes

ROOT = Path(__file__).parents[2]
ROSIES_HEAD = ROOT / "examples" / "head.toml"
DORA = ROOT / "examples" / "dora.toml"
C_GRIPPER = ROOT / "examples" / "c_gripper"


class Program:
    """A child process whose output is read line by line, with a deadline on every wait."""

    def __init__(self, *words: str | Path, inside: str = "") -> None:
        namespace = ("ip", "netns", "exec", inside) if inside else ()
        self.process = subprocess.Popen(
            [*namespace, sys.executable, *map(str, words)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            bufsize=1,
            start_new_session=True,
        )
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self.errors: list[str] = []
        self._readers = [threading.Thread(target=self._read), threading.Thread(target=self._complaints)]
        for reader in self._readers:
            reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._lines.put(line)
        self._lines.put(None)

    def _complaints(self) -> None:
        assert self.process.stderr is not None
        self.errors.extend(self.process.stderr)

    def line(self) -> str:
        """The next line of output; fails if there is none in time."""
        try:
            line = self._lines.get(timeout=PATIENCE_S)
        except queue.Empty:
            pytest.fail(f"no output of {self.process.args} within {PATIENCE_S} s; stderr: {''.join(self.errors)}")
        if line is None:
            pytest.fail(f"{self.process.args} ended; stderr: {''.join(self.errors)}")
        return line

    def lines(self) -> list[str]:
        """All further output, once it has ended."""
        self.wait()
        return list(iter(self._lines.get_nowait, None))

    def json(self) -> dict[str, Any]:
        return json.loads(self.line())

    def wait_for(self, wanted: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """The next JSON line that is as wanted."""
        while not wanted(message := self.json()):
            pass
        return message

    def wait(self) -> int:
        """Wait for its end; the exit code."""
        code = self.process.wait(PATIENCE_S)
        for reader in self._readers:
            reader.join(PATIENCE_S)
        return code

    def signal(self, number: int) -> None:
        os.kill(self.process.pid, number)

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(10)
            except subprocess.TimeoutExpired:
                self.process.kill()
        with suppress(ProcessLookupError):  # a process that it started and left keeps its pipes open
            os.killpg(self.process.pid, signal.SIGKILL)
        self.wait()
        for stream in (self.process.stdout, self.process.stderr):
            assert stream is not None
            stream.close()


@pytest.fixture
def c_gripper(tmp_path: Path) -> Path:
    """The program of examples/c_gripper, beside its compiled library."""
    folder = tmp_path / "c_gripper"
    folder.mkdir()
    library(C_GRIPPER / "gripper.c", folder / "libgripper.so")
    return shutil.copy(C_GRIPPER / "gripper.py", folder)


@pytest.fixture
def run(system: str) -> Iterator[Callable[..., Program]]:
    """Starts Python programs in the test's system, also inside of a network namespace; ends them."""
    programs: list[Program] = []

    def start(*words: str | Path, inside: str = "") -> Program:
        programs.append(Program(*words, inside=inside))
        return programs[-1]

    yield start
    for program in reversed(programs):
        program.close()


@pytest.fixture
def trade_command(system: str) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Runs ``trade WORDS`` to its end."""

    def command(*words: str | Path) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "trade_gateway", *map(str, words)],
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )

    return command


class Rosie:
    """``trade up examples/head.toml --sim``, ready."""

    def __init__(self, program: Program, log: Path) -> None:
        self.program = program
        self.log = log
        self.ready = program.json()


@pytest.fixture
def rosie_up(run: Callable[..., Program], tmp_path: Path) -> Callable[[], Rosie]:
    """Brings rosie up, simulated, in a process of its own."""
    counter = iter(range(100))

    def up() -> Rosie:
        log = tmp_path / f"bytes-{next(counter)}.jsonl"
        robot = patient_copy(ROSIES_HEAD, tmp_path)
        return Rosie(run("-m", "trade_gateway", "up", robot, "--sim", "--sim-log", log, "--json"), log)

    return up


@contextmanager
def networks_of_ones_own() -> Generator[Networks]:
    """Hosts and networks; skips where there can be none, and fails there in CI."""
    reason = why_not()
    if reason and os.environ.get("CI") == "true":
        pytest.fail(f"{reason}; in CI this is part of what must hold")
    if reason:
        pytest.skip(reason)
    made = Networks()
    try:
        yield made
    finally:
        made.close()


@pytest.fixture
def networks() -> Iterator[Networks]:
    """Hosts and networks of the test's own; see above."""
    with networks_of_ones_own() as made:
        yield made


class Bench:
    """Simulated servos and, apart from them, a driver process that can be killed and started again."""

    def __init__(self, sim: SimProcess, up: Callable[[], Program]) -> None:
        self.sim = sim
        self._up = up
        self.restart()

    def restart(self) -> None:
        """Start the driver; an earlier one must have ended."""
        self.driver = self._up()
        self.driver.json()

    def rests(self, joint: str, since: float = 0.0) -> list[float]:
        """Where a joint came to rest."""
        entries = events(self.sim.entries(), "at_rest", since=since)
        return [entry.position_rad or 0.0 for entry in entries if entry.joint == joint]

    def stopped_short(self, since: float, most_rad: float) -> None:
        """The pan joint comes to rest before that, stopped by the driver and not by its own watchdog."""
        wait_until(lambda: bool(self.rests("neck.pan", since)))
        assert self.rests("neck.pan", since)[0] < most_rad
        assert writes(self.sim.entries(), device_id=1, register="goal_position", since=since)
        assert not events(self.sim.entries(), "watchdog_expired")

    def moving(self) -> bool:
        return any(abs(device.velocity_rad_s) > 0 for bus in self.sim.control.state() for device in bus.devices)


def patient_copy(robot_file: Path, folder: Path) -> Path:
    """A copy of a robot file whose drivers and devices wait longer for each other: they share a processor."""
    copy = folder / robot_file.name
    text = re.sub(r"(?m)^driver = .*", r"\g<0>\nstale_after_s = 1", robot_file.read_text(encoding="utf-8"))
    copy.write_text(re.sub(r"(?m)^watchdog_s = [\d.]+", "watchdog_s = 1", text), encoding="utf-8")
    return copy


def at_ports(robot_file: Path, sim: SimProcess, folder: Path) -> Path:
    """A patient copy of a robot file that names the ports of its simulation."""
    copy = patient_copy(robot_file, folder)
    text = copy.read_text(encoding="utf-8")
    for bus, port in sim.ports.items():
        text = re.sub(rf'(\[bus\.{bus}\][^\[]*?port = )"[^"]*"', rf'\g<1>"{port}"', text)
    copy.write_text(text, encoding="utf-8")
    return copy


@pytest.fixture
def benches(system: str, tmp_path: Path, run: Callable[..., Program]) -> Iterator[Callable[..., Bench]]:
    """Brings a robot up, its servos and its driver in processes of their own."""
    with ExitStack() as undo:

        def start(robot_file: Path, inside: str = "") -> Bench:
            sim = undo.enter_context(SimProcess(robot_file))
            copy = at_ports(robot_file, sim, tmp_path)
            bench = Bench(sim, lambda: run("-m", "trade_gateway", "up", copy, "--json", inside=inside))
            undo.callback(lambda: bench.driver.close())  # noqa: PLW0108 - the driver there is then
            return bench

        yield start


@pytest.fixture
def bench(benches: Callable[..., Bench]) -> Bench:
    return benches(ROSIES_HEAD)


@pytest.fixture
def keeping(system: str, tmp_path: Path, start_container: Callable[..., Container]) -> Iterator[Callable[..., Keeping]]:
    made: list[Keeping] = []

    def keep(text: str, grace_s: float = 20.0) -> Keeping:
        made.append(Keeping(tmp_path, start_container(f"door{len(made)}"), grace_s))
        made[-1].set_children(text)
        return made[-1]

    yield keep
    for one in made:
        one.supervisor.close()


@pytest.fixture
def sshd(system: str, tmp_path: Path) -> Iterator[Sshd]:
    """This host as another one, where Python finds a module ``sight``."""
    missing = why_no_sshd()
    if missing:
        if os.environ.get("CI") == "true":
            pytest.fail(missing)
        pytest.skip(missing)
    folder = tmp_path / "ssh"
    folder.mkdir()
    package = tmp_path / "packages"
    package.mkdir()
    (package / "sight.py").write_text(
        "from trade import service\nclass Eye:\n    @service(effect='read')\n    def see(self) -> str: return 'a cat'\n"
    )
    names = ("TRADE_RUNTIME_DIR", "TRADE_STATE_DIR")
    running = Sshd(folder, {**{name: os.environ[name] for name in names}, "PYTHONPATH": str(package)})
    yield running
    running.close()
