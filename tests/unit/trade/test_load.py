"""How busy containers are, as they tell it themselves."""

import threading
import time
from pathlib import Path
from typing import Any

import psutil
import pytest

from tests.support.waiting import wait_until
from trade import Container, Handle, service, where
from trade._telemetry import load as module
from trade._telemetry.load import LoadMeter
from trade._threads.channel_workers import WorkerPool

pytestmark = pytest.mark.virtual_time


class Clerk:
    def __init__(self, gate: Any) -> None:
        self.gate = gate

    @service(serial=True)
    def file(self) -> str:
        return self.gate.pass_through()

    @service(effect="read")
    def look(self) -> int:
        return 1


def load_of(asker: Container, name: str) -> Handle:
    return asker.find(where(name="load", container=name), wait_s=20)


def test_calls_of_others_are_counted_and_ones_own_are_not(here: Container, there: Container, gate: Any) -> None:
    there.register(Clerk(gate), "office")
    look, load = here.find(where(name="look"), wait_s=20), load_of(here, "there")
    before = load().calls
    for _ in range(20):
        look()
    for _ in range(30):
        there.find(where(name="look"))()
    assert load().calls - before == 21  # and the second question


def test_the_load_report_counts_running_and_queued_calls(here: Container, there: Container, gate: Any) -> None:
    there.register(Clerk(gate), "office")
    file, load = here.find(where(name="file"), wait_s=20), load_of(here, "there")
    runs = [file.start() for _ in range(3)]
    assert gate.entered.wait(20)
    wait_until(lambda: load().queued == 2)
    wait_until(lambda: load().in_flight == 2)  # one that files, and the question
    gate.open.set()
    assert [run.result(20) for run in runs] == ["through"] * 3
    wait_until(lambda: (load().queued, load().in_flight) == (0, 1))


def test_the_load_report_agrees_with_the_operating_system(here: Container) -> None:
    reported, process = here.system.load(), psutil.Process()
    assert (reported.container, reported.cores) == ("here", psutil.cpu_count())
    assert reported.threads == threading.active_count()
    assert reported.memory_bytes is not None
    assert 0.5 < reported.memory_bytes / process.memory_info().rss < 2
    assert reported.load_1min is not None


class Elapsing:
    """A clock that the test moves."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def none_queued() -> int:
    return 0


def test_a_process_that_works_has_more_than_one_that_waits() -> None:
    clock = Elapsing()
    load = LoadMeter("c", list[WorkerPool], none_queued, clock)
    end = time.process_time() + 0.2
    while time.process_time() < end:
        pass
    clock.now_s += 2.0
    worked = load.read()
    clock.now_s += 2.0
    assert worked.over_s == 2.0
    assert worked.cpu_percent >= 10.0  # 0.2 of 2 s
    assert load.read().cpu_percent < worked.cpu_percent


def test_load_readings_less_than_a_second_apart_cover_a_longer_period() -> None:
    clock = Elapsing()
    load = LoadMeter("c", list[WorkerPool], none_queued, clock)
    reported = list[float]()
    for later_s in (0.5, 2.0, 0.5, 0.5, 1.0):
        clock.now_s += later_s
        reported.append(load.read().over_s)
    assert reported == [0.5, 2.5, 3.0, 1.0, 1.0]


@pytest.mark.real_clock
def test_a_figure_that_the_operating_system_does_not_have_is_none(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delattr("os.getloadavg")
    monkeypatch.setattr(module, "_STATUS", tmp_path / "status")
    monkeypatch.setattr(module, "_STAT", tmp_path / "stat")
    reported = LoadMeter("c", list[WorkerPool], none_queued).read()
    assert (reported.host_cpu_percent, reported.load_1min, reported.memory_bytes) == (None, None, None)


def test_the_share_of_the_host_leaves_out_what_idles(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    stat = tmp_path / "stat"
    monkeypatch.setattr(module, "_STAT", stat)
    stat.write_text("cpu  100 10 50 800 40 0 0 0 30 0\ncpu0 1 1 1 1 1 1 1 1 1 1\n")
    load = LoadMeter("c", list[WorkerPool], none_queued)
    stat.write_text("cpu  160 10 70 900 60 0 0 0 90 0\n")
    assert load.read().host_cpu_percent == pytest.approx(40.0)  # 60 and 20 of 200
