"""From a box of new devices to a robot that moves, by commands alone, as the docs show it."""

import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Final, NamedTuple

import pytest

from tests.support.waiting import PATIENCE_S, wait_until
from tests.system.conftest import ROOT
from trade_hil_sim import SimControl, read_log

PAGE: Final = ROOT / "docs" / "commissioning.md"
MARKS: Final = ("<!-- transcript: made by test_new_devices_become_a_robot -->\n", "<!-- end of transcript -->\n")
POSITION: Final = 132


class Step(NamedTuple):
    """A command, what it is good for, and what happens meanwhile."""

    why: str
    command: str
    kind: str = "run"
    """``run``, ``up`` (runs in the background), or ``calibrate`` (a joint is moved by hand)."""
    counts: tuple[int, int, int] = (0, 0, 0)
    """Where a joint is moved to: its zero, and both ends."""
    code: int = 0
    """What it ends with."""


STEPS: Final = (
    Step(
        "This command simulates a box of new devices: two servos on one line, a gripper on another. Skip it if you "
        "have hardware.",
        "trade-hil-sim --fresh neck=dynamixel:XL430-W250,XL430-W250 --fresh hand=robotiq:2F-85 --dir lines &",
        "up",
    ),
    Step("Scan the line of the servos.", "trade scan --port lines/neck", code=1),
    Step(
        "Both have the factory setting, id 1. Unplug the second one. This command unplugs the simulated one.",
        "trade-hil-sim --do lines/_control absent nth=2 bus=neck",
    ),
    Step("Give the remaining one another id.", "trade set-id --port lines/neck --from 1 --to 2"),
    Step(
        "Plug the second one in again.",
        "trade-hil-sim --do lines/_control absent nth=2 on=false bus=neck",
    ),
    Step(
        "57600 baud is too slow for a hundred cycles a second, so set both to a higher rate.",
        "trade set-baud --port lines/neck --id 1 --to 1000000",
    ),
    Step("", "trade set-baud --port lines/neck --id 2 --to 1000000"),
    Step(
        "Generate a first robot file of all devices. `--ids` limits the scan and makes it faster.",
        "trade scan --port lines/neck --port lines/hand --ids 1-9 --write rosie.toml",
    ),
    Step(
        "Name the devices, in an editor or with this command: `joint1_2` is the joint with id 2 on the first line.",
        """sed -i 's/joint1_1/"neck.pan"/; s/joint1_2/"neck.tilt"/; s/gripper2_9/"left.hand"/; s/"robot"/"rosie"/' """
        "rosie.toml",
    ),
    Step(
        "Measure zero and range of each joint. Move it by hand; its torque stays off. To move a simulated joint to a "
        "position in counts, type in another terminal: `trade-hil-sim --do lines/_control place counts=2100 ids=1 "
        "bus=neck`.",
        "trade calibrate rosie.toml neck.pan",
        "calibrate",
        (2100, 1500, 2700),
    ),
    Step("", "trade calibrate rosie.toml neck.tilt", "calibrate", (2048, 1800, 2300)),
    Step("Check the whole robot.", "trade doctor rosie.toml | grep 'neck\\|hand'"),
    Step("Start the robot, and let it look to the left.", "trade up rosie.toml &", "up"),
    Step("", "trade call rosie.neck.pan.enable"),
    Step("", "trade call rosie.neck.pan.move_to 0.3"),
)


class Bench:
    """A terminal in an empty folder, and two hands."""

    def __init__(self, folder: Path, undo: ExitStack) -> None:
        self._folder, self._undo = folder, undo
        self._log = folder / "bytes.jsonl"
        words = [os.fspath(Path(sys.executable).parent), os.environ["PATH"]]
        self._environment = {**os.environ, "PATH": os.pathsep.join(words), "COLUMNS": "200"}

    def type(self, step: Step) -> str:
        """A step as the page has it."""
        said = {"run": self._run, "up": self._up, "calibrate": self._calibrate}[step.kind](step)
        said = said.replace(str(self._folder), "/home/you")
        said = re.sub(r"^\d\d:\d\d:\d\d ", "", said, flags=re.MULTILINE)
        said = re.sub(r"-?\d+\.\d{5,}", lambda found: f"{float(found[0]):.1f}", said)
        return f"{step.why}\n\n" * bool(step.why) + f"```console\n$ {step.command}\n{said}```\n\n"

    def _run(self, step: Step) -> str:
        ended = subprocess.run(
            step.command,
            shell=True,
            check=False,
            cwd=self._folder,
            env=self._environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=PATIENCE_S,
        )
        assert ended.returncode == step.code, f"{step.command}: {ended.stdout}"
        return ended.stdout

    def _start(self, words: list[str]) -> "subprocess.Popen[str]":
        process = subprocess.Popen(
            words,
            cwd=self._folder,
            env=self._environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            bufsize=1,
        )
        self._undo.callback(self._end, process)
        return process

    @staticmethod
    def _end(process: "subprocess.Popen[str]") -> None:
        process.terminate()
        process.communicate(timeout=PATIENCE_S)

    def _up(self, step: Step) -> str:
        words = shlex.split(step.command)[:-1]
        simulator = words[0] == "trade-hil-sim"
        process = self._start([*words, "--log", str(self._log)] if simulator else words)
        said, last = "", '"ready":true' if simulator else "Ctrl-C leaves"
        while last not in said:
            said += self._line(process)
        if simulator:
            ready = json.loads(said)
            said = json.dumps({**ready, "log": None}, separators=(",", ":")) + "\n"
        return said

    @staticmethod
    def _line(process: "subprocess.Popen[str]") -> str:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line, f"{process.args} has ended"
        return line

    def _calibrate(self, step: Step) -> str:
        process = self._start(shlex.split(step.command))
        device_id = 1 if step.command.endswith("pan") else 2
        zero, low, high = step.counts
        said = self._line(process)
        self._move(device_id, zero)
        self._press(process, "\n")
        said += self._line(process)
        self._move(device_id, low)
        self._move(device_id, high)
        self._press(process, "\n")
        self._press(process, "y\n")
        assert process.stdout is not None
        said += process.stdout.read()
        assert process.wait(PATIENCE_S) == 0
        return said.replace("[y/N]: ", "[y/N]: y\n")

    @staticmethod
    def _press(process: "subprocess.Popen[str]", keys: str) -> None:
        assert process.stdin is not None
        process.stdin.write(keys)
        process.stdin.flush()

    def _move(self, device_id: int, counts: int) -> None:
        """Turn a shaft by hand, and hold it there until it was looked at."""
        with SimControl(self._folder / "lines" / "_control") as control:
            control.place(counts, [device_id], bus="neck")
        before = self._looks(device_id)
        wait_until(lambda: self._looks(device_id) > before + 2, "the position is read")

    def _looks(self, device_id: int) -> int:
        return sum(
            one.kind == "instruction" and one.name == "read" and one.address == POSITION
            for one in read_log(self._log)
            if one.device_id == device_id
        )


@pytest.fixture
def bench(system: str, tmp_path: Path) -> Iterator[Bench]:
    with ExitStack() as undo:
        yield Bench(tmp_path, undo)


@pytest.mark.slow
@pytest.mark.timeout(300)  # it asks every id at every rate
def test_new_devices_become_a_robot(bench: Bench) -> None:
    """With WRITE_TABLES=1 in the environment the page's transcript is written again."""
    reported = "\n" + "".join(bench.type(step) for step in STEPS)
    before, mark, rest = PAGE.read_text(encoding="utf-8").partition(MARKS[0])
    shown, end, after = rest.partition(MARKS[1])
    if os.environ.get("WRITE_TABLES"):
        PAGE.write_text(before + mark + reported + end + after, encoding="utf-8")
        return
    assert reported == shown
