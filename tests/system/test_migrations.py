"""Providers that move between processes, one of which is killed at each stage; judged by the log they write."""

import itertools
import json
import subprocess
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import trade
from tests.support.waiting import wait_until
from trade import where
from trade.errors import TradeError

COUNTER = '''
import os, pathlib, signal, threading, time
from trade import service

HERE = pathlib.Path(__file__).parent

def fate(stage, pid=None):
    """Whether it is the end, and whose."""
    word, _, delay_s = (HERE / "fate").read_text().partition(" ")
    if word == stage:
        kill = lambda: os.kill(pid or os.getpid(), signal.SIGKILL)
        threading.Timer(float(delay_s), kill).start() if delay_s else kill()

class Counter:
    def __init__(self) -> None:
        self.total = 0
        fate("made")

    @service
    def count(self) -> int:
        self.total += 1
        with (HERE / "log").open("a") as log:
            log.write(f"{os.getpid()} {self.total}\\n")
        return self.total

    def save_state(self):
        fate("save")
        return {"total": self.total, "pid": os.getpid()}

    def restore_state(self, state) -> None:
        self.total = state["total"]
        fate("target")
        fate("source", state["pid"])

    def close(self) -> None:
        fate("close")
'''


class Caller:
    """Calls the counter, wherever it is, for as long as it lasts."""

    def __init__(self) -> None:
        self.answers = 0
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._call)

    def _call(self) -> None:
        while not self._over.is_set():
            try:
                trade.find(where(name="count"), wait_s=0).with_(deadline_s=1)()
                self.answers += 1
            except TradeError:
                self._over.wait(0.001)

    def __enter__(self) -> "Caller":
        self._thread.start()
        wait_until(lambda: self.answers > 10)
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """With module ``counters``, importable in child processes, the log, and what is to happen when."""
    (tmp_path / "counters.py").write_text(COUNTER)
    (tmp_path / "fate").write_text("none")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return tmp_path


@pytest.fixture
def two(run: Any, folder: Path) -> Iterator[dict[str, Any]]:
    """Containers ``old``, which counts, and ``new``."""
    programs = {
        name: run("-m", "trade_gateway", "container", "--name", name, "--allow", "counters:*", "--json")
        for name in ("old", "new")
    }
    for program in programs.values():
        program.json()
    instantiate = trade.find(where(name="instantiate", container="old"), wait_s=30)
    instantiate("counters:Counter", (), ["hall"])
    trade.find(where(name="prepare_arrival", container="new"), wait_s=30)
    yield programs


def offered() -> list[str]:
    return [one.container for one in trade.services(where(name="count"))]


def served(folder: Path) -> list[tuple[int, list[int]]]:
    """Who counted, in order, and to what."""
    lines = [tuple(map(int, line.split())) for line in (folder / "log").read_text().splitlines()]
    return [(pid, [total for _, total in some]) for pid, some in itertools.groupby(lines, key=lambda line: line[0])]


STAGES: dict[str, list[str]] = {
    "save": [],
    "source": [],
    "made": ["old"],
    "target": ["old"],
    "close": ["new"],
}


@pytest.mark.parametrize("stage", STAGES)
def test_a_provider_is_alive_at_most_once_when_a_process_is_killed_at_any_stage(
    two: dict[str, Any], folder: Path, stage: str
) -> None:
    pids = {name: program.process.pid for name, program in two.items()}
    before = trade.find(where(name="count"), wait_s=30)
    with Caller() as caller:
        (folder / "fate").write_text(stage)
        with pytest.raises(TradeError):
            trade.migrate(before, to="new")
        dead = "new" if STAGES[stage] == ["old"] else "old"
        assert two[dead].wait() == -9
        (folder / "fate").write_text("none")
        wait_until(lambda: offered() == STAGES[stage])
        if STAGES[stage]:
            answers = caller.answers
            wait_until(lambda: caller.answers > answers)
    assert offered() == STAGES[stage]
    assert before.alive == (STAGES[stage] == ["old"])
    assert_alive_once(folder, [pids[name] for name in ("old", *STAGES[stage])])


@pytest.mark.parametrize("who", ["source", "target"])
@pytest.mark.parametrize("delay_s", [0.002, 0.004, 0.008, 0.016])
def test_a_provider_is_alive_at_most_once_when_a_process_is_killed_near_the_handover(
    two: dict[str, Any], folder: Path, who: str, delay_s: float
) -> None:
    pids = {name: program.process.pid for name, program in two.items()}
    with Caller():
        (folder / "fate").write_text(f"{who} {delay_s}")
        run = threading.Thread(target=attempt)
        run.start()
        assert two["old" if who == "source" else "new"].wait() == -9
        run.join(60)
        assert not run.is_alive()
        wait_until(lambda: len(offered()) < 2)
    assert_alive_once(folder, [pids["old"], pids["new"]])


def attempt() -> None:
    try:
        trade.migrate(where(name="count"), to="new")
    except TradeError:
        return


def assert_alive_once(folder: Path, pids: list[int]) -> None:
    """Those counted one after the other, and each later one continued from where the one before was."""
    found = served(folder)
    who = [pid for pid, _ in found]
    assert who == list(dict.fromkeys(pids))[: len(who)]
    totals = [total for _, some in found for total in some]
    assert totals == list(range(1, len(totals) + 1))


def test_it_is_moved_on_the_command_line(
    two: dict[str, Any], folder: Path, trade_command: Callable[..., subprocess.CompletedProcess[str]]
) -> None:
    pids = {name: program.process.pid for name, program in two.items()}
    with Caller() as caller:
        ended = trade_command("migrate", "hall", "--to", "n*", "--json")
        assert ended.returncode == 0, ended.stderr
        [listed] = json.loads(ended.stdout)
        assert (listed["service"], listed["container"]) == ("hall.count", "new")
        answers = caller.answers
        wait_until(lambda: caller.answers > answers)
    assert_alive_once(folder, [pids["old"], pids["new"]])
    refused = trade_command("migrate", "hall", "--to", "nowhere")
    assert (refused.returncode, "no service matches" in refused.stderr) == (3, True)
