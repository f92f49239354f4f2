"""A simulated tail on a pty in this process, the driver attached to it, and the simulator's log as the judge."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from tests.support.simulated_robots import TAIL, patient
from tests.support.waiting import wait_until
from trade_drivers import AttachedRobot, Motor, Robot, attach, parse
from trade_hil_sim import DeviceState, Entry, events, motion_writes, writes
from trade_hil_sim.feetech import FeetechBus, Servo

__all__ = ["COUNTS_PER_RAD", "LEAD_S", "TailRig", "goal_of", "lead_counts", "measured_before", "tail_rig"]

COUNTS_PER_RAD = 651.8986
_GOAL = 42
LEAD_S = 0.3
_NEAR = 20
"""Counts that a joint is sent ahead at least."""


class TailRig:
    """A simulated bus and the driver attached to it."""

    def __init__(self, tmp_path: Path, undo: ExitStack) -> None:
        self._tmp_path, self._undo = tmp_path, undo
        self.robot: Robot = patient(parse(TAIL, "tail.toml"))

    def configure(self, *changes: tuple[str, str]) -> None:
        """Change the robot file's text."""
        text = TAIL
        for before, after in changes:
            assert before in text, before
            text = text.replace(before, after)
        self.robot = patient(parse(text, "tail.toml"))

    def plug(
        self, *servos: Servo, prepare: Callable[[FeetechBus], None] = lambda _: None, paced: bool = False
    ) -> FeetechBus:
        """Simulate the bus of the robot file, or these servos."""
        port = self._tmp_path / "tail"
        if servos:
            self.sim = FeetechBus(servos, port, name="tail", paced=paced)
        else:
            bus = self.robot.buses[0]
            self.sim = FeetechBus.from_robot(bus, self.robot.joints_on(bus.name), port, paced=paced)
        prepare(self.sim)
        return self._undo.enter_context(self.sim)

    def attach(self, **options: Any) -> AttachedRobot:
        """Attach the driver; it is closed with the test, whatever that says."""
        options.setdefault("ports", {"tail": str(self.sim.port)})
        options.setdefault("register", lambda *_: None)
        options.setdefault("deregister", lambda _: None)
        robot = attach(self.robot, **options)
        self._undo.callback(_close, robot)
        return robot

    def root(self, **options: Any) -> Motor:
        return self.attach(**options).motor("tail.root")

    @property
    def log(self) -> list[Entry]:
        return list(self.sim.log.entries)

    def goals(self, device_id: int | None = None, since: float = 0.0) -> list[Entry]:
        """Writes that touch a goal position."""
        return writes(self.log, device_id=device_id, register="goal_position", since=since)

    def moves(self, device_id: int | None = None, since: float = 0.0) -> list[Entry]:
        """Writes that could set something moving."""
        return motion_writes(self.log, device_id=device_id, since=since)

    def events(self, name: str, device_id: int | None = None, since: float = 0.0) -> list[Entry]:
        return events(self.log, name, device_id=device_id, since=since)

    def wait_for(self, name: str, device_id: int | None = None, since: float = 0.0) -> Entry:
        """The first such event from then on."""
        wait_until(lambda: self.events(name, device_id, since), f"{name} of {device_id}")
        return self.events(name, device_id, since)[0]

    def truth(self, device_id: int = 1) -> DeviceState:
        return next(device for device in self.sim.state().devices if device.device_id == device_id)

    def servo(self, device_id: int = 1) -> Servo:
        return next(servo for servo in self.sim.devices if servo.device_id == device_id)

    def poke(self, address: int, *data: int, device_id: int = 1) -> None:
        """Write to a servo's memory as if another program had."""
        self.servo(device_id).write(address, bytes(data), time.monotonic())


def goal_of(entry: Entry) -> int:
    """The goal position that a write carries."""
    assert entry.address is not None
    at = _GOAL - entry.address
    return int.from_bytes(entry.data[at : at + 2], "little")


def lead_counts(speed_rad_s: float, accel_rad_s2: float = 20.0) -> float:
    """How far ahead of a measurement a joint may be sent: what it takes until it has to be heard again, and braking."""
    return max(_NEAR, (speed_rad_s * LEAD_S + speed_rad_s**2 / (2 * accel_rad_s2)) * COUNTS_PER_RAD) + 2


def measured_before(log: list[Entry], write: Entry) -> int:
    """The position that the servo had last reported when this write came."""
    reported = [entry for entry in log if entry.kind == "sent" and entry.device_id == write.device_id]
    reported = [entry for entry in reported if entry.name == "sync_read" and entry.t <= write.t]
    return int.from_bytes(reported[-1].data[5:7], "little")


@contextmanager
def tail_rig(tmp_path: Path) -> Iterator[TailRig]:
    with ExitStack() as undo:
        yield TailRig(tmp_path, undo)


def _close(robot: AttachedRobot) -> None:
    try:
        robot.close()
    except Exception as error:  # noqa: BLE001 - what closing says is tested where it matters
        print(f"closing: {error}")
