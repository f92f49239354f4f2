"""The jitter of bus loops: each cycle is seen once on its wire, and what is far off is seen in table and picture."""

import os
import threading
import time
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.bench import _jitter, page
from tests.bench._fifo import fifo, threads_of, why_no_fifo
from tests.bench._histograms import histograms
from tests.bench._jitter import BUSES, Bus, Case, NotSeen, off_us, spread_of
from tests.bench._jitter_driver import busy_with
from tests.bench._record import Histogram, Point, Run, Spread
from tests.bench._report import begin_part, this_run
from tests.bench.test_page import a_run
from trade_drivers import AttachedRobot, attach, load_driver, parse
from trade_drivers.plugins._driver import Driver
from trade_hil_sim import SimProcess

ROOT = Path(__file__).parents[2]
EDGES = (-100.0, -10.0, 10.0, 100.0)
SECONDS = 1.0
LOADED_S = 4.0
LATE_US = 1000.0
"""A tenth of the period."""


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Iterator[Run]:
    """What this test's bench measures; its processes find the modules of the bench as they are found here."""
    monkeypatch.syspath_prepend(ROOT)
    this_run.cache_clear()
    begin_part("jitter")
    yield this_run()
    this_run.cache_clear()


def measured(attached: AttachedRobot, name: str) -> int:
    [value] = [one.value for one in attached.measures() if one.name == name]
    return int(value)


@pytest.mark.parametrize("bus", BUSES, ids=lambda bus: bus.driver)
def test_a_cycle_is_seen_once_on_its_wire(bus: Bus, tmp_path: Path) -> None:
    if missing := load_driver(bus.driver, "test", Driver).missing():
        pytest.skip(f"{missing[0]} is not installed")
    robot, file = parse(bus.text, "jitter.toml"), tmp_path / "jitter.toml"
    file.write_text(bus.text)
    with SimProcess(file) as sim, attach(robot, ports=sim.ports, announced=False) as attached:
        busy = busy_with(robot, attached)
        before, missed, began = (
            measured(attached, "bus_cycles"),
            measured(attached, "bus_missed_answers"),
            time.monotonic(),
        )
        busy(SECONDS)
        cycles, ended = measured(attached, "bus_cycles") - before, time.monotonic()
        missed = measured(attached, "bus_missed_answers") - missed
        seen = sum(bus.begins_cycle(entry) for entry in sim.entries() if began <= entry.t <= ended)
    least = 1 if bus.driver == "ur" else cycles - missed - 2  # an arm is sent nothing before its stream begins
    assert least <= seen <= cycles + 2


def test_a_bus_is_measured_in_each_case_and_so_is_a_loop_with_nothing_in_it(
    run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    dynamixel = BUSES[0]
    _jitter.run(20, [dynamixel])
    cases = ["quiet", "load"] if why_no_fifo() else ["quiet", "quiet, SCHED_FIFO", "load", "load, SCHED_FIFO"]
    lost = {one.name for one in run.skipped}  # too busy a machine loses devices
    names = ("nothing, 100 Hz", dynamixel.name, f"{dynamixel.name}, trade up")
    wanted = {(name, case) for name in names for case in cases if not {name, f"{name}, {case}"} & lost}
    assert {(point.case, point.name) for point in run.points} == wanted
    assert all(point.n == sum(point.histogram.counts) > 0 for point in run.points if point.histogram)
    assert all(point.histogram for point in run.points)
    assert capsys.readouterr().out.count("quiet  ") >= 1


def test_P12_on_a_loaded_computer_a_bus_in_real_time_is_late_less_often_than_an_ordinary_one(run: Run) -> None:
    if reason := why_no_fifo():
        pytest.skip(reason)
    dynamixel = BUSES[0]
    with _jitter._driven(dynamixel, real=True) as loop:
        late = {
            real: sum(
                abs(off) > LATE_US
                for off in off_us(_jitter._turn(loop, Case(load=True, real=real), LOADED_S)[0], dynamixel.rate_hz)
            )
            for real in (False, True)
        }
    few = 0.01 * LOADED_S * dynamixel.rate_hz
    assert late[True] <= max(few, late[False] / 2), late


def test_no_case_runs_in_real_time_without_permission_and_the_reason_is_shown(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse, raising=False)
    _jitter.run(5, [], loaded=False)
    assert [point.name for point in run.points] == ["quiet"]
    [skipped] = run.skipped
    assert skipped.name == "drivers in real time"
    assert "Operation not permitted" in skipped.reason


def test_threads_are_in_real_time_for_a_while_and_then_as_before() -> None:
    if reason := why_no_fifo():
        pytest.skip(reason)
    ended = threading.Event()
    other = threading.Thread(target=ended.wait)
    other.start()
    assert other.native_id in threads_of(os.getpid())
    with fifo(lambda: [other.native_id], 1):
        assert os.sched_getscheduler(other.native_id) == os.SCHED_FIFO
        assert os.sched_getscheduler(threading.get_native_id()) == os.SCHED_OTHER
    assert os.sched_getscheduler(other.native_id) == os.SCHED_OTHER
    ended.set()
    other.join()


def test_what_is_off_is_the_time_between_two_cycles_less_the_period() -> None:
    assert off_us([1.0, 1.01, 1.025, 1.03], 100) == pytest.approx([0.0, 5000.0, -5000.0], abs=1e-6)
    with pytest.raises(NotSeen):
        off_us([1.0], 100)


def test_the_spread_shows_one_late_cycle_in_a_thousand_and_the_mean_shows_a_missed_period() -> None:
    assert spread_of([0.0] * 999 + [700.0]) == {
        **dict.fromkeys(("p50", "p95", "p99"), 0.0),
        **dict.fromkeys(("p99.9", "most"), 700.0),
        "mean": pytest.approx(0.7),
    }
    assert spread_of([50.0] * 10)["mean"] == 50.0


def test_a_histogram_counts_each_figure_once_and_what_is_on_an_edge_above_it() -> None:
    histogram = Histogram.of([-1e6, -100.0, -11.0, -10.0, 0.0, 10.0, 99.9, 100.0, 1e9], EDGES)
    assert histogram.counts == (1, 2, 2, 2, 2)


def jittery(name: str, counts: tuple[int, ...]) -> Point:
    values = {"p50, us": Spread.of([0.25]), "most, us": Spread.of([-12340.0])}
    return Point("jitter", "some bus", name, sum(counts), values, Histogram(EDGES, counts))


def test_histograms_have_a_row_a_point_and_one_of_a_thousand_is_seen() -> None:
    drawn, high = histograms("some <bus>", [jittery("quiet", (0, 0, 999, 0, 1)), jittery("load", (1, 1, 1, 1, 1))])
    root = ET.fromstring(f"<svg>{drawn}</svg>")
    bars = [one.attrib["d"] for one in root.iter("path") if "stroke" not in one.attrib]
    assert len(bars) == 2 + 5
    heights = [float(bar.partition("v-")[2].partition("h")[0]) for bar in bars]
    assert heights[0] > heights[1] > 2
    assert all(0 < float(one.attrib["y"]) < high for one in root.iter("text"))
    assert {"some <bus>, us", "quiet", "load", "-100", "100"} <= set(root.itertext())


def test_the_page_shows_table_and_histograms_of_a_run_that_has_the_part_and_says_nothing_of_one_that_has_not(
    tmp_path: Path,
) -> None:
    assert "itter" not in page.written(a_run(), page.Why())
    run = a_run()
    run.points.append(jittery("quiet", (0, 0, 999, 0, 1)))
    run.write(tmp_path / "run.json")
    made = page.files(Run.read(tmp_path / "run.json"), page.Why())
    assert "![Jitter of bus loops](pictures/performance-jitter.svg)" in made["performance.md"]
    assert "| quiet | 1,000 | 0.25 | -12,340 |" in made["performance.md"]
    assert "the period" in made["performance.md"]
    ET.fromstring(made["pictures/performance-jitter.svg"])
