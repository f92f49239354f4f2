"""The Feetech bus: how close the driver comes to what the wire can carry, and what it costs at a robot's rate.

Six simulated servos at 1 Mbaud. A cycle reads position, speed and load of all and writes all goals with their
acceleration and speed, as the driver does for joints on their way. Beside it runs a bare loop, ready-made packets on a
file descriptor, which shows what simulator and kernel leave of the wire.
"""

import os
import select
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from statistics import median

import serial

from tests.bench._report import keep_point, print_target
from tests.bench._servo import Answers, Cycle, _cycles_per_s, _load, _measure, _range
from trade_drivers import parse
from trade_drivers.vendors.feetech import FeetechDriver
from trade_hil_sim import SimProcess
from trade_hil_sim.feetech import encode

_COUNT = 6
_BAUD = 1_000_000
_READ = (56, 6)
_WRITE, _GOAL = 41, bytes((130, 0, 8, 0, 0, 100, 0))
_SYNC_READ, _SYNC_WRITE = 0x82, 0x83
_IDS = range(1, _COUNT + 1)
_RATE_HZ = 100
_LEAST_SHARE, _MOST_CPU = 0.85, 0.15

_BUS = """
[robot]
name = "bench"

[bus.arm]
driver = "feetech"
port = "/dev/ttyNOWHERE"
baud = {baud}
rate_hz = {rate_hz}
"""
_JOINT = """
[joint."arm.j{id}"]
bus = "arm"
id = {id}
model = "STS3215"
min_rad = -1.4
max_rad = 1.4
max_speed_rad_s = 2.5
max_accel_rad_s2 = 20.0
"""


def run(cycles: int, rounds: int, seconds: float) -> None:
    """Measure and print; arguments as of the servo part."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        robot_file = Path(folder) / "arm.toml"
        robot_file.write_text(
            _BUS.format(baud=_BAUD, rate_hz=_RATE_HZ) + "".join(_JOINT.format(id=device_id) for device_id in _IDS)
        )
        loops: dict[tuple[str, bool], Cycle] = {}
        for who, opened in (("driver", _driver), ("bare loop", _bare)):
            sim = stack.enter_context(SimProcess(robot_file, logged=False))
            loops[who, False] = stack.enter_context(opened(robot_file, sim.ports["arm"]))
        speeds = _measure("Feetech, cycles", loops, rounds, lambda cycle: _cycles_per_s(cycle, cycles))
        driver = {key: cycle for key, cycle in loops.items() if key[0] == "driver"}
        name = f"Feetech, {_RATE_HZ} Hz"
        loads = _measure(name, driver, max(1, rounds // 2), lambda cycle: _load(cycle, seconds))
    limit = _BAUD / 10 / _cycle_bytes()
    print(f"Feetech bus: {_COUNT} servos, {_BAUD} baud; medians over {rounds} rounds of {cycles} cycles")
    print(f"  {_cycle_bytes()} bytes a cycle, limit {limit:.0f} cycles/s")
    shares = {who: [hz / limit for hz in found] for (who, _), found in speeds.items()}
    for (who, _), found in speeds.items():
        print(f"    {who:10} {median(found):6.0f} cycles/s {_range(shares[who])} of the limit")
        keep_point(f"{_COUNT} servos", who, cycles * rounds, {"cycles/s": found, "of the wire": shares[who]})
    wanted = f"at least {_LEAST_SHARE}"
    print_target("Feetech sync / limit", shares["driver"], wanted, lambda share: share >= _LEAST_SHARE)
    [load] = loads.values()
    keep_point(f"{_RATE_HZ} Hz", "driver", len(load), {"% of a core": [100 * one for one in load]})
    print_target(f"CPU at {_RATE_HZ} Hz, Feetech", load, f"at most {_MOST_CPU}", lambda share: share <= _MOST_CPU)


@contextmanager
def _driver(robot_file: Path, port: str) -> Iterator[Cycle]:
    """The driver's whole cycle, and goals for all joints behind it. Torque is off: nothing moves."""
    robot = parse(robot_file.read_text(), robot_file.name)
    exchange = FeetechDriver().open_exchange(robot, robot.buses[0], port)
    goals = dict.fromkeys(_IDS, _GOAL)

    def cycle() -> None:
        exchange.cycle()
        exchange.wire.sync_write(_WRITE, goals)
        answers.count(all_there=not any(axis.silent or axis.doubted for axis in exchange.devices))

    answers = Answers()
    try:
        yield cycle
    finally:
        exchange.wire.close()


@contextmanager
def _bare(robot_file: Path, port: str) -> Iterator[Cycle]:
    """Ready-made packets; answers are counted, not looked at."""
    ask, write, answer_size = _ask(), _goals(), _answer_bytes()
    with serial.Serial(port, _BAUD, timeout=0, exclusive=True) as line:
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


def _ask() -> bytes:
    return encode(0xFE, _SYNC_READ, bytes((*_READ, *_IDS)))


def _goals() -> bytes:
    values = b"".join(bytes((device_id,)) + _GOAL for device_id in _IDS)
    return encode(0xFE, _SYNC_WRITE, bytes((_WRITE, len(_GOAL))) + values)


def _answer_bytes() -> int:
    return _COUNT * (6 + _READ[1])


def _cycle_bytes() -> int:
    return len(_ask()) + _answer_bytes() + len(_goals())
