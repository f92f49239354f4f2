"""A simulated head on a pty in this process, the driver attached to it, and the simulator's log as the judge."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.support.simulated_robots import HEAD
from tests.support.waiting import PATIENCE_S
from tests.unit.drivers.bus_rig import ServoRig
from tests.unit.drivers.gate import Gate
from trade._context.call_context import CallContext, running
from trade.errors import DeviceSilent
from trade_drivers import AttachedRobot
from trade_hil_sim import DynamixelBus, LogEntry, Servo

GOAL, TORQUE, WATCHDOG = 116, 64, 98


def sleep_past(moment_ns: int) -> None:
    """Let a moment of the monotonic clock pass."""
    while time.monotonic_ns() <= moment_ns:
        threading.Event().wait(0.005)


@contextmanager
def call(deadline_s: float) -> Iterator[int]:
    """What a provider sees while it serves a remote call: when that expires."""
    expires_ns = time.monotonic_ns() + int(deadline_s * 1e9)
    token = running.set(CallContext(id=1, service="test", caller="test", session="test", expires_ns=expires_ns))
    try:
        yield expires_ns
    finally:
        running.reset(token)


class Outcome:
    """A call running in a thread of its own."""

    def __init__(self, act: Callable[[], Any], deadline_s: float | None = None) -> None:
        self.result: Any = None
        self.error: BaseException | None = None
        self._act, self._deadline_s = act, deadline_s
        self._thread = threading.Thread(target=self._run, name="caller")
        self._thread.start()

    def _run(self) -> None:
        try:
            if self._deadline_s is None:
                self.result = self._act()
            else:
                with call(self._deadline_s):
                    self.result = self._act()
        except BaseException as error:  # noqa: BLE001 - raised in the thread that waits
            self.error = error

    def wait(self) -> "Outcome":
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive(), "the call has not ended"
        return self


class Rig(ServoRig):
    """Two Dynamixel servos."""

    original, file, sim_class, servo_class = HEAD, "head.toml", DynamixelBus, Servo
    first, second, group = "neck.pan", "neck.tilt", "head"

    def goal_of(self, entry: LogEntry) -> int:
        return goal_counts(entry)

    def move_by_another(self, goal: int) -> None:
        """The first servo moves slowly on the command of another program."""
        servo, now = next(servo for servo in self.sim.devices if servo.device_id == 1), time.monotonic()
        servo.write(64, b"\1", now)
        servo.write(112, (5).to_bytes(4, "little") + goal.to_bytes(4, "little"), now)


@pytest.fixture
def gate() -> Iterator[Gate]:
    made = Gate()
    yield made
    made.release()


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with ExitStack() as undo:
        yield Rig(tmp_path, undo)


@pytest.fixture
def head(rig: Rig) -> Rig:
    """A plugged-in head."""
    rig.plug()
    return rig


@pytest.fixture
def robot(head: Rig) -> AttachedRobot:
    return head.attach()


def goal_counts(entry: LogEntry) -> int:
    """The goal position that a write carries: always its last four bytes here."""
    return int.from_bytes(entry.data[-4:], "little", signed=True)


def written_now() -> float:
    """A mark in the log's time."""
    return time.monotonic()


def is_silent(robot: AttachedRobot, joint: str) -> bool:
    try:
        robot.motor(joint).state()
    except DeviceSilent:
        return True
    return False
