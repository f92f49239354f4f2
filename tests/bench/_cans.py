"""The CAN bus: how punctual the cycles of six drives are near the most that 1 Mbit/s can carry.

Simulated drives on a paced hub, in a process of its own. A cycle is a SYNC, a position for each drive and its frames of
status, with all of the driver's work around it: they follow a trajectory in cyclic synchronous position. Late is a
cycle that begins more than one and a half periods after the one before. Beside it an empty loop shows what the machine
leaves of the same rate at that time.
"""

import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from statistics import median

from tests.bench._report import keep_point, print_target
from trade.errors import DeviceError, TradeError
from trade_drivers import Motor, Tolerances, Trajectory, TrajectoryPoint, parse
from trade_drivers.bus.can import frame_bits
from trade_drivers.joints import BusThread
from trade_drivers.joints.can._driver import AttachedMotors
from trade_drivers.vendors.cia402 import Cia402Driver
from trade_drivers.vendors.cia402 import _table as table
from trade_drivers.vendors.cia402._homing import Drive
from trade_hil_sim import SimProcess
from trade_robotfile import CanBus

_COUNT = 6
_BITRATE = 1_000_000
_MOST_LATE = 1.0
_ATTEMPTS = 5
_WAIT_S = 0.001
_CASES = ((500, 1), (400, 2))
"""Cycles a second, and TPDOs of each drive in each."""
_WIDE = Tolerances(start_rad=1.0, path_rad=2.0, goal_rad=1.0, goal_time_s=5.0)

_BUS = """
[robot]
name = "bench"

[bus.legs]
driver = "cia402"
interface = "socketcan"
channel = "can0"
bitrate = {bitrate}
rate_hz = {rate_hz}
stale_after_s = 1.0
watchdog_s = 1.0
"""
_JOINT = """
[joint."leg.j{id}"]
bus = "legs"
id = {id}
model = "ACME-EC60"
counts_per_rev = 4096
gear = 50
min_rad = -1.4
max_rad = 1.4
max_speed_rad_s = 2.5
max_accel_rad_s2 = 20.0
"""


def run(rounds: int, seconds: float) -> None:
    """Measure and print.

    Args:
        rounds: trajectories of each case.
        seconds: how long one lasts.
    """
    for rate_hz, tpdos in _CASES:
        late: list[float] = []
        empty: list[float] = []
        lasted_s: list[float] = []
        spent_s: list[float] = []
        for i in range(rounds):
            try:
                began, took, spent = _drives(rate_hz, tpdos, seconds)
            except TradeError as lost:  # too busy a machine loses the drives altogether
                print(f"can, {rate_hz} Hz: all of a round counts as late: {lost}", file=sys.stderr, flush=True)
                late.append(100.0)
            else:
                late.append(_late(began, rate_hz))
                lasted_s += took
                spent_s.append(spent)
            empty.append(_late(_ticks(rate_hz, seconds), rate_hz))
            print(f"can, {rate_hz} Hz: round {i + 1} of {rounds}", file=sys.stderr, flush=True)
        _print(rate_hz, tpdos, late, empty, lasted_s, spent_s)


def _drives(rate_hz: int, tpdos: int, seconds: float) -> tuple[list[float], list[float], float]:
    """When the cycles of one trajectory began, how long each took, and the processor time of one, in seconds."""
    text = _BUS.format(bitrate=_BITRATE, rate_hz=rate_hz) + "".join(_JOINT.format(id=i + 1) for i in range(_COUNT))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "legs.toml"
        file.write_text(text)
        robot = parse(text, file.name)
        [bus] = robot.buses
        assert isinstance(bus, CanBus)
        with SimProcess(file, logged=False) as sim:
            exchange = Cia402Driver().open_exchange(robot, bus, sim.ports["legs"])
            if tpdos == 2:
                for axis in exchange.devices:
                    every_sync = table.DictionaryEntry(table.MOTION.communication, "u1", 2)
                    for _ in exchange.nodes.write(axis.id, every_sync, table.AT_NEXT_SYNC):
                        exchange.net.take_in(_WAIT_S)
            began, took, cycle = list[float](), list[float](), exchange.cycle

            def timed() -> None:
                began.append(time.monotonic())
                cycle()
                took.append(time.monotonic() - began[-1])

            thread = BusThread(exchange, exchange.port, bus, lambda: True, name="bus bench")
            attached = AttachedMotors(thread, exchange.port, Drive)
            thread.start()
            try:
                for joint in robot.joints:
                    _enable(attached.motor(joint.name))
                exchange.cycle = timed
                names = [axis.name for axis in exchange.devices]
                ways = [(0.0, 0.0), (seconds / 2, 0.3), (seconds, 0.0)]
                points = [TrajectoryPoint(time_from_start_s=at, positions_rad=_COUNT * [rad]) for at, rad in ways]
                group = attached.group("leg", [joint.name for joint in robot.joints])
                spent_s = -time.process_time()
                group.follow(Trajectory(joints=names, points=points), _WIDE)
                spent_s += time.process_time()
            finally:
                thread.close()
    return began, took, spent_s / len(began)


def _enable(motor: Motor) -> None:
    """A machine that is busy loses answers: several attempts."""
    for _ in range(_ATTEMPTS - 1):
        with suppress(DeviceError):
            return motor.enable()
    return motor.enable()


def _ticks(rate_hz: int, seconds: float) -> list[float]:
    """When the cycles of a loop with nothing in it began."""
    began = [time.monotonic()]
    while began[-1] < began[0] + seconds:
        time.sleep(max(0.0, began[0] + len(began) / rate_hz - time.monotonic()))
        began.append(time.monotonic())
    return began


def _late(began: Sequence[float], rate_hz: int) -> float:
    """In per cent."""
    gaps = [after - before for before, after in pairwise(began)]
    return 100 * sum(gap > 1.5 / rate_hz for gap in gaps) / len(gaps)


def _print(
    rate_hz: int,
    tpdos: int,
    late: Sequence[float],
    empty: Sequence[float],
    lasted_s: Sequence[float],
    spent_s: Sequence[float],
) -> None:
    sizes = [table.FOLLOWING.layout.size, table.STATUS.layout.size, table.MOTION.layout.size][: 1 + tpdos]
    bits = frame_bits(0) + _COUNT * sum(frame_bits(size) for size in sizes)
    ordered = sorted(lasted_s)
    print(
        f"CAN bus: {_COUNT} drives, {_BITRATE} bit/s, {rate_hz} Hz, 1 RPDO and {tpdos} TPDO each, {len(ordered)} cycles"
    )
    print(f"  a cycle has {bits} bits at most, so the wire ends at {_BITRATE / bits:.0f} Hz")
    if ordered:
        p50, p99 = ordered[len(ordered) // 2], ordered[len(ordered) * 99 // 100]
        print(f"  cycle, ms: p50 {1e3 * p50:.2f}  p99 {1e3 * p99:.2f}  period {1e3 / rate_hz:.2f}")
        print(f"  processor time of the driver, ms a cycle: {1e3 * median(spent_s):.2f}")
        values = {
            "p50, ms": [1e3 * p50],
            "p99, ms": [1e3 * p99],
            "CPU, ms": [1e3 * one for one in spent_s],
            "late, %": late,
        }
        keep_point(f"{rate_hz} Hz, {tpdos} TPDO", "cycle of six drives", len(ordered), values)
    keep_point(f"{rate_hz} Hz, {tpdos} TPDO", "empty loop", len(empty), {"late, %": empty})
    print(f"  late in an empty loop: {median(empty):.2f} % ({min(empty):.2f}-{max(empty):.2f})")
    what = f"late at {rate_hz} Hz, {tpdos} TPDO, %"
    print_target(what, late, f"below {_MOST_LATE:g}", lambda share: share < _MOST_LATE)
