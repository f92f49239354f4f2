"""A simulated tail on a pty in this process, the driver attached to it, and the simulator's log as the judge."""

import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from tests.support.simulated_robots import TAIL
from tests.unit.drivers.bus_rig import ServoRig
from trade_drivers import Motor
from trade_hil_sim import LogEntry
from trade_hil_sim.feetech import FeetechBus, Servo

__all__ = ["COUNTS_PER_RAD", "LEAD_S", "TailRig", "goal_of", "lead_counts", "measured_before", "rig", "tail"]

COUNTS_PER_RAD = 651.8986
_GOAL = 42
LEAD_S = 0.3
_NEAR = 20
"""Counts that a joint is sent ahead at least."""


class TailRig(ServoRig):
    """Two Feetech servos."""

    original, file, sim_class, servo_class = TAIL, "tail.toml", FeetechBus, Servo
    first, second, group = "tail.root", "tail.tip", "tail"

    def goal_of(self, entry: LogEntry) -> int:
        return goal_of(entry)

    def move_by_another(self, goal: int) -> None:
        """The first servo moves slowly on the command of another program."""
        self.poke(40, 1)
        self.poke(41, 20, *goal.to_bytes(2, "little"), 0, 0, *(200).to_bytes(2, "little"))

    def root(self, **options: Any) -> Motor:
        return self.attach(**options).motor("tail.root")

    def servo(self, device_id: int = 1) -> Servo:
        return next(servo for servo in self.sim.devices if servo.device_id == device_id)

    def poke(self, address: int, *data: int, device_id: int = 1) -> None:
        """Write to a servo's memory as if another program had."""
        self.servo(device_id).write(address, bytes(data), time.monotonic())


def goal_of(entry: LogEntry) -> int:
    """The goal position that a write carries."""
    assert entry.address is not None
    at = _GOAL - entry.address
    return int.from_bytes(entry.data[at : at + 2], "little")


def lead_counts(speed_rad_s: float, accel_rad_s2: float = 20.0) -> float:
    """How far ahead of a measurement a joint may be sent: what it takes until it has to be heard again, and braking."""
    return max(_NEAR, (speed_rad_s * LEAD_S + speed_rad_s**2 / (2 * accel_rad_s2)) * COUNTS_PER_RAD) + 2


def measured_before(log: list[LogEntry], write: LogEntry) -> int:
    """The position that the servo had last reported when this write came."""
    reported = [entry for entry in log if entry.kind == "sent" and entry.device_id == write.device_id]
    reported = [entry for entry in reported if entry.name == "sync_read" and entry.t <= write.t]
    return int.from_bytes(reported[-1].data[5:7], "little")


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[TailRig]:
    with ExitStack() as undo:
        yield TailRig(tmp_path, undo)


@pytest.fixture
def tail(rig: TailRig) -> TailRig:
    """A plugged-in tail."""
    rig.plug()
    return rig
