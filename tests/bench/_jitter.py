"""How evenly the loops of buses turn: for each kind of bus, by how much the time between two cycles is off its period.

The wire is the judge: what counts is when a simulator, in a process of its own, has read the first question of each
cycle. Where the system allows it, that process runs in real time in all cases, above the driver, so that what it reads
late is not taken for lateness of the driver. A loop with nothing in it shows what the machine leaves of a period.

In real time is the whole process of a driver, with those it has started, as `chrt --all-tasks` and systemd have it. The
thread of its bus alone would wait for the interpreter, held by an ordinary thread that waits for a processor.
Each bus is measured in `trade up`, too: in real time by itself, with a priority of its own, and with --no-real-time.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from multiprocessing.connection import Connection
from pathlib import Path
from statistics import fmean
from typing import Final, NamedTuple

from tests.bench import _jitter_driver as driver
from tests.bench._children import child, hear
from tests.bench._fifo import fifo, threads_below, threads_of, why_no_fifo
from tests.bench._record import Histogram
from tests.bench._report import keep_point, print_skipped
from trade_drivers import load_driver
from trade_drivers.plugins._driver import Driver
from trade_hil_sim import LogEntry, SimProcess, SimulationError, read_log

EDGES_US: Final = (*(step * 10.0**decade for decade in range(1, 5) for step in (1, 2, 5)), 1e5)
"""Of the histograms, on either side of zero: two runs that are compared have the same ones."""
_QUANTILES: Final = {"p50": 0.5, "p95": 0.95, "p99": 0.99, "p99.9": 0.999}
_DRIVER_PRIORITY, _SIM_PRIORITY = 50, 60
_COUNT: Final = 4
_PATIENCE_S: Final = 30.0
_LEAST_S: Final = 1.0
_BUSY: Final = """
import select, sys
print("busy", flush=True)
while not select.select([sys.stdin], [], [], 0)[0]:
    for _ in range(100_000):
        pass
"""

_HEAD: Final = """
[robot]
name = "bench"

[bus.it]
driver = "{driver}"
rate_hz = {rate_hz}
stale_after_s = 1.0
"""
_SERVOS: Final = f'port = "{driver.ANYWHERE}"\nbaud = 1_000_000\nwatchdog_s = 0.5\n'
_CAN: Final = f'{driver.CAN0}\nbitrate = 1_000_000\nwatchdog_s = 0.5\nleave = "relax"\n'
_JOINT: Final = """
[joint."j{id}"]
bus = "it"
id = {id}
{device}
min_rad = -1.4
max_rad = 1.4
max_speed_rad_s = 2.5
max_accel_rad_s2 = 20.0
"""
_GRIPPER: Final = f"""port = "{driver.ANYWHERE}"
baud = 115_200

[gripper.hand]
bus = "it"
id = 9
model = "2F-85"
max_width_m = 0.085
max_speed_m_s = 0.10
max_force_n = 100.0
"""
_ARM: Final = f"""host = "{driver.ADDRESS}"

[arm.arm]
bus = "it"
model = "UR5e"
min_rad = [-3.1, -3.1, -2.8, -3.1, -3.1, -3.1]
max_rad = [3.1, 0.1, 2.8, 3.1, 3.1, 3.1]
max_speed_rad_s = 1.0
max_accel_rad_s2 = 2.5
max_speed_m_s = 0.5
max_accel_m_s2 = 1.2
"""


def _joints(device: str) -> str:
    """So many of a kind; the first one stays without torque."""
    names = ", ".join(f'"j{n}"' for n in range(2, _COUNT + 1))
    joints = "".join(_JOINT.format(id=n, device=device) for n in range(1, _COUNT + 1))
    return f"{joints}\n[group.{driver.GROUP}]\njoints = [{names}]\n"


@dataclass(frozen=True)
class Bus:
    """A kind of bus, and how the first question of a cycle is known in the simulator's log."""

    driver: str
    rate_hz: float
    rest: str
    """Of the robot file, behind what all have."""
    marks: tuple[str, ...]
    """Names of instructions or frames: any of them."""
    device_id: int | None = None
    """Only those to this device, where each has a question of its own."""

    @property
    def name(self) -> str:
        return f"{self.driver}, {self.rate_hz:g} Hz"

    @property
    def text(self) -> str:
        """The robot file."""
        return _HEAD.format(driver=self.driver, rate_hz=self.rate_hz) + self.rest

    def begins_cycle(self, entry: LogEntry) -> bool:
        asked = entry.kind == "instruction" or (entry.kind == "frame" and entry.direction == "in")
        return asked and entry.name in self.marks and self.device_id in (None, entry.device_id)


BUSES: Final = (
    Bus(
        "dynamixel",
        100,
        _SERVOS + _joints('model = "XL430-W250"'),
        ("sync_read", "fast_sync_read"),
    ),
    Bus("feetech", 100, _SERVOS + _joints('model = "STS3215"'), ("sync_read",)),
    Bus("cia402", 200, _CAN + _joints('model = "ACME-EC60"\ncounts_per_rev = 4096\ngear = 50'), ("sync",)),
    Bus("damiao", 200, _CAN + _joints('model = "DM4310"'), ("refresh",), 1),
    Bus(
        "odrive", 200, _CAN + _joints('model = "ODrive S1"\ngear = 8\nzero = "last"'), ("ask_get_encoder_estimates",), 1
    ),
    Bus("robotiq", 100, _GRIPPER, ("read_input",)),
    Bus("ur", 125, _ARM, ("servo_j",)),
)
"""At the rates that a robot is meant for; of the gripper faster, that it may not take all day."""
IDLE_HZ: Final = 100.0


def run(cycles: int, buses: Sequence[Bus] = BUSES, *, loaded: bool = True) -> None:
    """Measure and print.

    Args:
        cycles: of each bus in each case.
        buses: which.
        loaded: whether the cases with a busy process for each processor are measured, too.
    """
    refused = why_no_fifo()
    print(f"jitter: time between two cycles less the period, us; {cycles} cycles, {os.cpu_count()} processors")
    if refused:
        print_skipped("drivers in real time", f"{refused}; what the simulator read late counts as late, too")
    reals = (False,) if refused else (False, True)
    cases = [Case(load, real) for load in ((False, True) if loaded else (False,)) for real in reals]
    _measure(f"nothing, {IDLE_HZ:g} Hz", IDLE_HZ, _nothing(), cases, cycles)
    for bus in buses:
        if missing := load_driver(bus.driver, "bench", Driver).missing():
            print_skipped(bus.name, f"{missing[0]} is not installed")
            continue
        _measure(bus.name, bus.rate_hz, _driven(bus, real=not refused), cases, cycles)
        for real in reals:
            turns = [case for case in cases if case.real is real]
            up = _brought_up(bus, real=real, sim_real=not refused)
            _measure(f"{bus.name}, trade up", bus.rate_hz, up, turns, cycles)


class Case(NamedTuple):
    """Under which a loop turns."""

    load: bool
    """One busy process for each processor."""
    real: bool
    """Its process is SCHED_FIFO."""

    @property
    def name(self) -> str:
        return ("load" if self.load else "quiet") + (", SCHED_FIFO" if self.real else "")


class NotSeen(Exception):
    """No cycle was, or one alone."""


class Loop:
    """One that turns in a process of its own."""

    def __init__(self, pipe: Connection) -> None:
        self._pipe = pipe
        self._pid: int = hear(pipe)

    def threads(self) -> list[int]:
        """Those of its process, and of the processes that this has started."""
        return [*threads_of(self._pid), *threads_below(self._pid)]

    def turn(self, seconds: float) -> tuple[Sequence[float], str]:
        """When the cycles of so many seconds began, and what ended the motion before its end, or nothing."""
        self._pipe.send(seconds)
        return hear(self._pipe, seconds + _PATIENCE_S)


class DrivenLoop(Loop):
    """That of a bus: its simulator says when cycles began."""

    def __init__(self, pipe: Connection, bus: Bus, log: Path) -> None:
        super().__init__(pipe)
        self._bus, self._log = bus, log

    def turn(self, seconds: float) -> tuple[Sequence[float], str]:
        (began, ended), stopped = super().turn(seconds)
        log = read_log(self._log)
        return [one.t for one in log if began <= one.t <= ended and self._bus.begins_cycle(one)], stopped


class UpLoop(DrivenLoop):
    """That of a bus in `trade up`, which decides itself about real time."""

    def threads(self) -> list[int]:
        return []


@contextmanager
def _nothing() -> Iterator[Loop]:
    with child(driver.idle, IDLE_HZ) as pipe:
        yield Loop(pipe)


@contextmanager
def _driven(bus: Bus, *, real: bool) -> Iterator[Loop]:
    with _simulated(bus, real=real) as sim, child(driver.drive, bus.text, sim.ports) as pipe:
        yield DrivenLoop(pipe, bus, sim.log_path)


@contextmanager
def _brought_up(bus: Bus, *, real: bool, sim_real: bool) -> Iterator[Loop]:
    with (
        tempfile.TemporaryDirectory() as folder,
        _simulated(bus, real=sim_real) as sim,
        child(partial(driver.bring_up, real=real), bus.text, sim.ports["it"], Path(folder)) as pipe,
    ):
        yield UpLoop(pipe, bus, sim.log_path)


@contextmanager
def _simulated(bus: Bus, *, real: bool) -> Iterator[SimProcess]:
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        file = Path(folder) / "robot.toml"
        file.write_text(bus.text)
        sim = stack.enter_context(SimProcess(file))
        if real:
            stack.enter_context(fifo(lambda: threads_of(sim.pid), _SIM_PRIORITY))
        yield sim


def _measure(
    name: str, rate_hz: float, opened: AbstractContextManager[Loop], cases: Sequence[Case], cycles: int
) -> None:
    print(f"{name}\n  {'':24}{'n':>7}" + "".join(f"{what:>10}" for what in (*_QUANTILES, "most", "mean")))
    try:
        with opened as loop:
            for case in cases:
                began, stopped = _turn(loop, case, max(_LEAST_S, cycles / rate_hz))
                try:
                    _keep(name, case.name, off_us(began, rate_hz))
                except NotSeen as nothing:
                    print_skipped(f"{name}, {case.name}", f"{nothing}; {stopped}")
                    continue
                if stopped:
                    print_skipped(f"{name}, {case.name}: the rest of the motion", stopped)
                print(f"jitter, {name}: {case.name}", file=sys.stderr, flush=True)
    except (RuntimeError, SimulationError) as lost:
        print_skipped(name, str(lost))


def _turn(loop: Loop, case: Case, seconds: float) -> tuple[Sequence[float], str]:
    with ExitStack() as stack:
        for _ in range(os.cpu_count() or 1) if case.load else ():
            stack.enter_context(_busy_process())
        if case.real:
            stack.enter_context(fifo(loop.threads, _DRIVER_PRIORITY))
        return loop.turn(seconds)


@contextmanager
def _busy_process() -> Iterator[None]:
    """One that does nothing but take a processor; it ends with the block, and with this process."""
    process = subprocess.Popen([sys.executable, "-S", "-c", _BUSY], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdin and process.stdout
    with process, process.stdin, process.stdout:
        process.stdout.read(1)
        yield


def off_us(began: Sequence[float], rate_hz: float) -> list[float]:
    """By how much the time from each cycle to the next exceeds the period; raises NotSeen if there is none."""
    if len(began) < 2:
        raise NotSeen("no cycles were seen on its wire")
    return [1e6 * (after - before - 1 / rate_hz) for before, after in pairwise(began)]


def spread_of(off: Sequence[float]) -> Mapping[str, float]:
    """The values of the table, in us. A mean that is not zero is a period that is not kept."""
    ordered = sorted(off)
    quantiles = {name: ordered[min(len(ordered) - 1, int(len(ordered) * share))] for name, share in _QUANTILES.items()}
    return {**quantiles, "most": ordered[-1], "mean": fmean(ordered)}


def _keep(name: str, case: str, off: Sequence[float]) -> None:
    figures = spread_of(off)
    print(f"  {case:24}{len(off):7}" + "".join(f"{figure:10.0f}" for figure in figures.values()))
    edges = [*(-edge for edge in reversed(EDGES_US)), *EDGES_US]
    values = {f"{what}, us": [figure] for what, figure in figures.items()}
    keep_point(name, case, len(off), values, Histogram.of(off, edges))
