"""What the log of faults keeps, forgets and writes down, on days when nothing goes right."""

import contextlib
import random
import resource
import signal
import sqlite3
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import msgspec
import pytest

from trade.errors import DeviceFault, DeviceSilent, InvalidArgument
from trade_drivers import FaultInfo, FaultLog, MotorState
from trade_drivers.faults import FaultStore
from trade_drivers.faults._fault_update import DetectedFault, found_in

PAN, TILT = "rosie.pan", "rosie.tilt"
HOT = DetectedFault("overheating", "rosie.pan: overheating", "let it cool")
LOAD = DetectedFault("overload", "rosie.pan: overload", "free it")


class Clocks:
    """Both clocks of a log."""

    def __init__(self) -> None:
        self.s, self.offset = 100.0, 1_000_000.0

    @property
    def wall(self) -> float:
        return self.offset + self.s


class CountingStore(FaultStore):
    """Counts what it is asked to write."""

    writes = 0

    def save(self, *about: Any) -> "Future[bool]":
        self.writes += 1
        return super().save(*about)


class Bench:
    """A log that is opened again and again, as by one process after another."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.clocks = Clocks()
        self.reported: list[str] = []
        self.log: FaultLog | None = None
        self.store: CountingStore

    def open(self, **options: Any) -> FaultLog:
        self.close()
        self.store = CountingStore(self.path, self.reported.append)
        clocks = self.clocks
        self.log = FaultLog("rosie", self.store, clock=lambda: clocks.s, wall=lambda: clocks.wall, **options)
        return self.log

    def close(self) -> None:
        if self.log is not None:
            self.log.close()

    def begin(self, found: DetectedFault = LOAD, device: str = PAN, moments: Any = ()) -> None:
        assert self.log is not None
        self.log.begin(device, found, self.clocks.wall, self.clocks.s, moments)

    def end(self, found: DetectedFault = LOAD, device: str = PAN) -> None:
        assert self.log is not None
        self.log.end(device, found.kind, self.clocks.wall, self.clocks.s)

    def written(self) -> None:
        """Let the disk take what it was given."""
        assert self.log is not None
        if self.log._saving is not None:
            self.log._saving.result(10)


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    made = Bench(tmp_path / "faults" / "rosie.sqlite")
    yield made
    made.close()


def state(position_rad: float, at_s: float) -> tuple[float, MotorState]:
    return at_s, MotorState(
        name=PAN,
        position_rad=position_rad,
        velocity_rad_s=0.5,
        load=-0.25,
        temperature_c=41.0,
        voltage_v=None,
        enabled=True,
        moving=False,
        measured_at=at_s,
        age_s=0.01,
    )


def only(log: FaultLog) -> FaultInfo:
    [info] = log.faults()
    return info


def test_a_fault_keeps_the_measurements_before_its_first_and_its_latest_occurrence(bench: Bench) -> None:
    log = bench.open()
    bench.begin(moments=[state(0.1, 99.5), state(0.2, 99.98)])
    bench.clocks.s += 10
    bench.end()
    bench.clocks.s += 5
    bench.begin(moments=[state(0.9, 114.0)])
    bench.clocks.s += 1
    fault = log.fault(only(log).id)
    assert [(sample.s, sample.values["position_rad"]) for sample in fault.first] == [(-0.5, 0.1), (-0.02, 0.2)]
    assert [(sample.s, sample.values["position_rad"]) for sample in fault.latest] == [(-1.0, 0.9)]
    measured = {"velocity_rad_s": 0.5, "load": -0.25, "temperature_c": 41.0, "enabled": 1.0, "moving": 0.0}
    assert fault.first[0].values == {"position_rad": 0.1, **measured}
    assert (fault.open, fault.count, fault.lasted_s) == (True, 2, pytest.approx(11))
    assert (fault.first_at, fault.last_at, fault.gone_at) == (1_000_100, 1_000_115, None)
    assert (fault.device, fault.kind, fault.text, fault.remedy) == (PAN, "overload", "rosie.pan: overload", "free it")


def test_a_fault_that_flickers_is_one_with_its_count_and_few_writes(bench: Bench) -> None:
    log = bench.open()
    for _ in range(1000):
        bench.begin(moments=[state(0.1, bench.clocks.s)] * 50)
        bench.clocks.s += 0.005
        bench.end()
        bench.clocks.s += 0.005
        log.save()
        bench.written()
    fault = log.fault(only(log).id)
    assert (fault.count, fault.open, len(fault.latest)) == (1000, False, 50)
    assert fault.lasted_s == pytest.approx(5)
    assert 2 <= bench.store.writes <= 12
    before = only(log)
    assert only(bench.open()) == before


def test_a_beginning_is_reported_at_once_and_a_fault_that_flickers_every_ten_seconds(bench: Bench) -> None:
    said: list[str] = []
    bench.open().report = said.append
    for _ in range(210):
        bench.begin()
        bench.begin()
        bench.end()
        bench.clocks.s += 0.1
    bench.begin(HOT)
    assert said == [*[LOAD.text] * 3, HOT.text]


def test_two_faults_of_one_joint_begin_and_end_one_by_one(bench: Bench) -> None:
    log = bench.open()
    bench.begin(LOAD)
    bench.begin(HOT)
    assert [info.kind for info in log.faults(open_only=True)] == ["overheating", "overload"]
    assert (log.health(PAN), log.health(TILT)) == ("overheating", "")
    bench.end(HOT)
    assert [info.kind for info in log.faults(open_only=True)] == ["overload"]
    assert log.health(PAN) == "overload"


@pytest.mark.parametrize("prefix", ["hardware error", "status", "error"])
def test_what_a_device_reports_in_one_text_is_taken_apart(prefix: str) -> None:
    error = DeviceFault(device=PAN, bus="x", fault=f"{prefix}: overload, overheating")
    assert [found.kind for found in found_in(PAN, error)] == [f"{prefix}: overload", f"{prefix}: overheating"]


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        (
            "it makes no progress, 0.123 rad short of its goal",
            "it makes no progress, 1e-05 rad short of its goal",
            True,
        ),
        (
            "another model answers with its id: 1020, not XL430",
            "another model answers with its id: 12, not XL430",
            True,
        ),
        ("error 8611h, following error", "error 2310h, following error", False),
        ("fault 0x0e, which the manual does not know", "fault 0x0b, which the manual does not know", False),
    ],
)
def test_different_numbers_do_not_make_another_fault_and_different_codes_do(one: str, other: str, same: bool) -> None:
    kinds = {found_in(PAN, DeviceFault(device=PAN, bus="x", fault=text))[0].kind for text in (one, other)}
    assert (len(kinds) == 1) is same


def test_a_fault_shows_its_latest_message_with_the_numbers(bench: Bench) -> None:
    log = bench.open()
    for short in ("0.3", "0.12"):
        error = DeviceFault(device=PAN, bus="x", fault=f"it makes no progress, {short} rad short of its goal")
        bench.begin(*found_in(PAN, error))
        said = f"it makes no progress, {short} rad short of its goal"
        assert (only(log).summary, log.health(PAN)) == (said, said)
        bench.end(*found_in(PAN, error))
    bench.begin(*found_in(PAN, DeviceSilent(device=PAN, bus="x", waited_s=0.3)))
    assert ([info.summary for info in log.faults(open_only=True)], log.health(PAN)) == (["silent"], "silent")
    assert len(log.faults()) == 2


def test_the_acknowledging_client_is_recorded_and_a_recurring_fault_is_unacknowledged_again(bench: Bench) -> None:
    log = bench.open()
    bench.begin()
    seen = log.acknowledge(only(log).id)
    assert (seen.open, seen.acknowledged_by, seen.acknowledged_at) == (True, "its own process", bench.clocks.wall)
    bench.end()
    assert only(log).acknowledged_by
    bench.begin()
    assert (only(log).acknowledged_by, only(log).acknowledged_at) == ("", None)


def test_evidence_is_added_and_bounded(bench: Bench) -> None:
    log = bench.open()
    bench.begin()
    for number in range(20):
        log.add_evidence(only(log).id, f"picture {number}")
    assert only(log).evidence == [f"picture {number}" for number in range(4, 20)]


@pytest.mark.parametrize(
    "ask", [FaultLog.fault, FaultLog.acknowledge, lambda log, its_id: log.add_evidence(its_id, "x")]
)
def test_an_id_that_is_none_is_named(bench: Bench, ask: Callable[[FaultLog, str], object]) -> None:
    with pytest.raises(InvalidArgument, match=r"there is no fault 'rosie-1'; `trade faults` lists"):
        ask(bench.open(), "rosie-1")


def test_a_clock_that_is_set_back_changes_neither_order_nor_durations(bench: Bench) -> None:
    log = bench.open()
    bench.begin(LOAD)
    bench.clocks.s += 2
    bench.clocks.offset -= 3600
    bench.end(LOAD)
    bench.begin(HOT)
    bench.clocks.s += 3
    hot, load = log.faults()
    assert (hot.kind, load.kind) == ("overheating", "overload")
    assert hot.last_at < load.last_at
    assert (hot.lasted_s, load.lasted_s) == (pytest.approx(3), pytest.approx(2))
    hot, load = bench.open().faults()
    assert (hot.kind, load.kind) == ("overheating", "overload")


def test_only_so_many_are_kept_and_the_acknowledged_that_are_gone_go_first(bench: Bench) -> None:
    log = bench.open(most=3)
    for kind in ("open", "gone", "gone and seen"):
        bench.begin(DetectedFault(kind, kind))
    bench.end(DetectedFault("gone", ""))
    bench.end(DetectedFault("gone and seen", ""))
    log.acknowledge(next(info.id for info in log.faults() if info.kind == "gone and seen"))
    wanted: set[str] = set()
    for new, wanted in (
        ("a", {"open", "gone", "a"}),
        ("b", {"open", "a", "b"}),
        ("c", {"a", "b", "c"}),
    ):
        bench.begin(DetectedFault(new, new))
        assert {info.kind for info in log.faults()} == wanted
    assert {info.kind for info in bench.open(most=3).faults()} == wanted


def test_what_was_open_and_is_found_again_at_once_is_the_same_fault_and_not_another_time(bench: Bench) -> None:
    log = bench.open()
    bench.begin()
    log.acknowledge(only(log).id)
    before = only(log)
    bench.clocks.s += 60
    log = bench.open()
    assert not log.faults(open_only=True)
    bench.clocks.s += 1
    bench.begin()
    assert (only(log).open, only(log).id, only(log).count, only(log).last_at) == (True, before.id, 1, before.last_at)
    assert only(log).acknowledged_by == "its own process"


def test_an_open_fault_that_is_not_found_again_is_closed_and_can_reopen(bench: Bench) -> None:
    bench.open()
    bench.begin()
    bench.clocks.s += 60
    log = bench.open()
    assert (only(log).open, only(log).gone_at) == (False, bench.clocks.wall)
    bench.clocks.s += 30
    bench.begin()
    assert (only(log).open, only(log).count) == (True, 2)


def test_samples_and_evidence_are_available_to_the_next_process(bench: Bench) -> None:
    log = bench.open()
    bench.begin(moments=[state(0.1, 99.5)])
    log.add_evidence(only(log).id, "a picture")
    bench.end()
    before = log.fault(only(log).id)
    assert bench.open().fault(before.id) == before


def test_faults_with_fields_of_a_later_version_are_read(bench: Bench) -> None:
    bench.open()
    bench.begin()
    bench.close()
    with contextlib.closing(sqlite3.connect(bench.path)) as file, file:
        [(blob,)] = file.execute("select blob from fault").fetchall()
        later = msgspec.msgpack.encode({**msgspec.msgpack.decode(blob), "zone": {"room": 2}})
        file.execute("alter table fault add column room text")
        file.execute("update fault set blob = ?", (later,))
    log = bench.open()
    assert only(log).device == PAN
    bench.begin(HOT, TILT)
    bench.written()
    assert bench.reported == []
    assert {info.device for info in bench.open().faults()} == {PAN, TILT}


@pytest.mark.parametrize("rubbish", [b"nonsense" * 1000, b"SQLite format 3\0" + random.Random(3).randbytes(9000)])
def test_a_file_that_is_corrupt_is_moved_aside_and_faults_are_kept_in_a_new_one(bench: Bench, rubbish: bytes) -> None:
    bench.path.parent.mkdir()
    bench.path.write_bytes(rubbish)
    bench.open()
    bench.begin()
    assert only(bench.open()).kind == "overload"
    assert bench.path.with_name("rosie.sqlite.corrupt-1").read_bytes() == rubbish
    assert ["is corrupt" in text for text in bench.reported] == [True]


def test_without_a_disk_faults_are_kept_in_memory_reported_once_and_written_later(bench: Bench) -> None:
    bench.path.parent.write_text("a file, where a folder should be")
    log = bench.open()
    bench.begin(LOAD)
    for _ in range(3):
        log.save()
        bench.written()
        bench.clocks.s += 1
    assert only(log).open
    assert [text.startswith("no fault is saved: ") for text in bench.reported] == [True]
    bench.path.parent.unlink()
    bench.end(LOAD)
    before = only(log)
    assert only(bench.open()) == before
    assert bench.reported[1].startswith("fault is saved again: ")


def test_on_a_full_disk_what_was_refused_is_written_when_there_is_room(bench: Bench) -> None:
    log = bench.open()
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (24 * 1024, hard))
        for number in range(20):
            bench.begin(DetectedFault(f"kind {'x' * number}", "x" * 4000))
            bench.clocks.s += 1
            log.save()
            bench.written()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, before)
    assert [text.startswith("no fault is saved: ") for text in bench.reported] == [True]
    assert len(log.faults()) == 20
    assert len(bench.open().faults()) == 20


def test_a_log_takes_saved_faults_of_its_own_devices_only(bench: Bench) -> None:
    """Two processes of a robot have a log each, and one file."""
    log = bench.open()
    bench.begin(device=PAN)
    bench.begin(device="rosie.elbow")
    bench.clocks.s += 1
    log.save()
    bench.written()
    assert [info.device for info in bench.open(devices=["rosie.elbow"]).faults()] == ["rosie.elbow"]
    assert {info.device for info in bench.open().faults()} == {PAN, "rosie.elbow"}
