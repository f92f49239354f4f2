"""The servo bus: how close the driver comes to what the wire can carry, and what it costs at a robot's rate.

Six simulated servos at 1 Mbaud that answer without delay. A cycle reads load, velocity and position of all and writes
all goals. Beside the driver runs a bare loop, ready-made packets on a file descriptor, which shows what simulator and
kernel leave of the wire.
"""

import os
import select
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from statistics import median

import serial

from tests.bench._report import keep_point, print_target
from trade_drivers import parse
from trade_drivers.vendors.dynamixel import DynamixelDriver
from trade_hil_sim import SimProcess
from trade_hil_sim.dynamixel import encode

_COUNT = 6
_BAUD = 1_000_000
_READ = (126, 10)
_GOAL, _GOAL_SIZE = 116, 4
_RETURN_DELAY = 9
_CENTRE = 2048
_SYNC_READ, _SYNC_WRITE, _FAST_SYNC_READ = 0x82, 0x83, 0x8A
_IDS = range(1, _COUNT + 1)
_RATE_HZ = 100
_LEAST_SHARE, _MOST_CPU = 0.75, 0.15
_WARM_UP = 50

_BUS = """
[robot]
name = "bench"

[bus.arm]
driver = "dynamixel"
port = "/dev/ttyNOWHERE"
baud = {baud}
rate_hz = {rate_hz}
fast_sync = {fast}
"""
_JOINT = """
[joint."arm.j{id}"]
bus = "arm"
id = {id}
model = "XL430-W250"
min_rad = -1.4
max_rad = 1.4
max_speed_rad_s = 2.5
max_accel_rad_s2 = 20.0
"""

_MOST_MISSED, _MOST_MISSED_SHARE = 3, 0.001

Cycle = Callable[[], object]


def run(cycles: int, rounds: int, seconds: float) -> None:
    """Measure and print.

    Args:
        cycles: exchanges in a round, as fast as they go.
        rounds: turns of each way to exchange.
        seconds: how long the loop at 100 Hz runs, in a round.
    """
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        loops: dict[tuple[str, bool], Cycle] = {}
        for fast in (True, False):
            robot_file = Path(folder) / f"{'fast' if fast else 'plain'}.toml"
            robot_file.write_text(_robot(fast=fast))
            for who, opened in (("driver", _driver), ("bare loop", _bare)):
                sim = stack.enter_context(SimProcess(robot_file, logged=False))
                loops[who, fast] = stack.enter_context(opened(robot_file, sim.ports["arm"], fast))
        speeds = _measure("cycles", loops, rounds, lambda cycle: _cycles_per_s(cycle, cycles))
        at_rate = {key: cycle for key, cycle in loops.items() if key[0] == "driver"}
        loads = _measure(f"{_RATE_HZ} Hz", at_rate, max(1, rounds // 2), lambda cycle: _load(cycle, seconds))
    _print(speeds, loads, cycles)


def _measure(
    what: str, loops: dict[tuple[str, bool], Cycle], rounds: int, measure: Callable[[Cycle], float]
) -> dict[tuple[str, bool], list[float]]:
    results: dict[tuple[str, bool], list[float]] = {key: [] for key in loops}
    for cycle in loops.values():
        for _ in range(_WARM_UP):
            cycle()
    for i in range(rounds):
        for key, cycle in loops.items():
            results[key].append(measure(cycle))
        print(f"servo, {what}: round {i + 1} of {rounds}", file=sys.stderr, flush=True)
    return results


def _cycles_per_s(cycle: Cycle, count: int) -> float:
    began = time.monotonic()
    for _ in range(count):
        cycle()
    return count / (time.monotonic() - began)


def _load(cycle: Cycle, seconds: float) -> float:
    """CPU time of this process as a share of one core, while it runs the cycle at the robot's rate."""
    next_at = began = time.monotonic()
    spent = time.process_time()
    while next_at < began + seconds:
        cycle()
        next_at += 1 / _RATE_HZ
        time.sleep(max(0.0, next_at - time.monotonic()))
    return (time.process_time() - spent) / (time.monotonic() - began)


class Answers:
    """How many cycles lacked an answer; a machine that is suspended for a moment loses one, a faulty bus many."""

    def __init__(self) -> None:
        self._cycles = self._missed = 0

    def count(self, *, all_there: bool) -> None:
        self._cycles += 1
        self._missed += not all_there
        if self._missed > max(_MOST_MISSED, _MOST_MISSED_SHARE * self._cycles):
            problem = f"in {self._missed} of {self._cycles} cycles a servo did not answer"
            raise RuntimeError(f"{problem}; the figures would mean nothing")


@contextmanager
def _driver(robot_file: Path, port: str, fast: bool) -> Iterator[Cycle]:
    """The driver's whole cycle, and goals for all joints behind it. Torque is off: nothing moves."""
    robot = parse(robot_file.read_text(), robot_file.name)
    exchange = DynamixelDriver().open_exchange(robot, robot.buses[0], port)
    for device_id in _IDS:
        exchange.wire.write(device_id, _RETURN_DELAY, b"\0")
    goals = {device_id: _CENTRE.to_bytes(_GOAL_SIZE, "little") for device_id in _IDS}

    def cycle() -> None:
        exchange.cycle()
        exchange.wire.sync_write(_GOAL, goals)
        answers.count(all_there=not any(axis.silent or axis.doubted for axis in exchange.devices))

    answers = Answers()
    try:
        yield cycle
    finally:
        exchange.wire.close()


@contextmanager
def _bare(robot_file: Path, port: str, fast: bool) -> Iterator[Cycle]:
    """Ready-made packets; answers are counted, not looked at."""
    ask, write, answer_size = _ask(fast), _write(), _answer_bytes(fast)
    with serial.Serial(port, _BAUD, timeout=0, exclusive=True) as line:
        for device_id in _IDS:
            line.write(encode(device_id, 3, _RETURN_DELAY.to_bytes(2, "little") + b"\0"))
            time.sleep(0.01)
        line.reset_input_buffer()
        poll = select.poll()
        poll.register(line.fd, select.POLLIN)

        def cycle() -> None:
            os.write(line.fd, ask)
            left = answer_size
            while left:
                if not poll.poll(1000):
                    raise RuntimeError("the servos did not answer; the figures would mean nothing")
                left -= len(os.read(line.fd, left))
            os.write(line.fd, write)

        yield cycle


def _robot(*, fast: bool) -> str:
    bus = _BUS.format(baud=_BAUD, rate_hz=_RATE_HZ, fast=str(fast).lower())
    return bus + "".join(_JOINT.format(id=device_id) for device_id in _IDS)


def _ask(fast: bool) -> bytes:
    block = _READ[0].to_bytes(2, "little") + _READ[1].to_bytes(2, "little")
    return encode(0xFE, _FAST_SYNC_READ if fast else _SYNC_READ, block + bytes(_IDS))


def _write() -> bytes:
    block = _GOAL.to_bytes(2, "little") + _GOAL_SIZE.to_bytes(2, "little")
    values = b"".join(bytes([device_id]) + _CENTRE.to_bytes(_GOAL_SIZE, "little") for device_id in _IDS)
    return encode(0xFE, _SYNC_WRITE, block + values)


def _answer_bytes(fast: bool) -> int:
    if fast:  # one header, then per device: error, id, data, checksum (protocol 2.0, fast sync read)
        return 8 + _COUNT * (_READ[1] + 4)
    return _COUNT * (11 + _READ[1])


def _limit_hz(fast: bool) -> float:
    return _BAUD / 10 / _cycle_bytes(fast)


def _cycle_bytes(fast: bool) -> int:
    return len(_ask(fast)) + _answer_bytes(fast) + len(_write())


def _print(
    speeds: dict[tuple[str, bool], list[float]], loads: dict[tuple[str, bool], list[float]], cycles: int
) -> None:
    rounds = len(speeds["driver", True])
    print(f"servo bus: {_COUNT} servos, {_BAUD} baud; medians over {rounds} rounds of {cycles} cycles")
    for fast in (True, False):
        name = "fast sync read" if fast else "sync read"
        limit = _limit_hz(fast)
        print(f"  {name}: {_cycle_bytes(fast)} bytes a cycle, limit {limit:.0f} cycles/s")
        for who in ("driver", "bare loop"):
            share = [hz / limit for hz in speeds[who, fast]]
            print(f"    {who:10} {median(speeds[who, fast]):6.0f} cycles/s {_range(share)} of the limit")
            values = {"cycles/s": speeds[who, fast], "of the wire": share}
            keep_point(f"{_COUNT} servos, {name}", who, rounds * cycles, values)
    for fast in (True, False):
        name = "fast" if fast else "plain"
        share = [hz / _limit_hz(fast) for hz in speeds["driver", fast]]
        load = loads["driver", fast]
        keep_point(f"{_RATE_HZ} Hz", f"driver, {name}", len(load), {"% of a core": [100 * one for one in load]})
        if fast:
            print_target("fast sync / limit", share, f"at least {_LEAST_SHARE}", lambda x: x >= _LEAST_SHARE)
        print_target(f"CPU at {_RATE_HZ} Hz, {name}", load, f"at most {_MOST_CPU}", lambda x: x <= _MOST_CPU)


def _range(values: Sequence[float]) -> str:
    return f"{median(values):5.2f} ({min(values):.2f}-{max(values):.2f})"
