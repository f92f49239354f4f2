"""The devices that the table of faults strikes: one of each kind, in the same words."""

import json
import os
import signal
import struct
from abc import ABC, abstractmethod
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from tests.support.waiting import PATIENCE_S, wait_until
from tests.unit.drivers.arm_rig import FAR, SLOW, ArmRig, children
from tests.unit.drivers.attached_arm import AT_HOME
from tests.unit.drivers.conftest import Outcome, Rig, goal_counts
from tests.unit.drivers.fault_row import Dashboard, Order, Process, Recovery, Sick
from tests.unit.drivers.gripper_rig import HandRig
from tests.unit.drivers.legs import HALT, HIP, Leg
from tests.unit.drivers.motor_rig import KINDS, ROOT
from tests.unit.drivers.tail_rig import TailRig, goal_of
from trade.errors import DeviceError, DeviceFault
from trade_drivers import Arm, Motor
from trade_drivers.vendors.ur._dashboard import ask
from trade_hil_sim import LogEntry, events, instructions, motion_writes, writes

__all__ = ["OWN_CLOCK", "SUBJECTS", "Subject"]

_BEATS = 15
"""Exchanges with a device in which something would have begun to move."""
_HERE_COUNTS = 6
_PATIENT = "stale_after_s = 0.8"
"""So that a loaded machine does not look like a fault."""


class Subject(ABC):
    """One simulated device, its driver, and the log as the judge."""

    device_id = 1
    ends = ("shutdown", "torque_off", "brown_out", "bus_off")
    """Events with which a device ends its motion itself."""

    def __init__(self, rig: Any) -> None:
        self.rig = rig
        self.well = True
        self.reported: dict[object, str] = {}
        self.robot = rig.attach(healthy=lambda: self.well, set_health=self.reported.__setitem__)
        self.provider = self.get()

    @abstractmethod
    def get(self) -> Any:
        """The provider."""

    @abstractmethod
    def go(self) -> object:
        """Make a slow move of several seconds."""

    @abstractmethod
    def use(self) -> None:
        """Move it there and back to where it begins; it must arrive."""

    @abstractmethod
    def share(self, place: Any) -> float:
        """How much of the slow move, 0 to 1, lies behind it where it was then, or is."""

    @abstractmethod
    def holds(self, since: float) -> list[LogEntry]:
        """The commands on the wire that make it hold or stop."""

    @abstractmethod
    def exchanges(self, since: float) -> list[LogEntry]:
        """What the driver asked it, and it could answer."""

    @property
    def truth(self) -> Any:
        return self.rig.truth(self.device_id)

    @property
    def travelled(self) -> float:
        """How much of the slow move it has really made, 0 to 1."""
        return self.share(self.truth)

    @property
    def log(self) -> list[LogEntry]:
        return list(self.rig.log)

    def moves(self, since: float) -> list[LogEntry]:
        """The commands it got that could move it."""
        return motion_writes(self.log, device_id=self.device_id, since=since)

    def events(self, name: str, since: float) -> list[LogEntry]:
        return events(self.log, name, device_id=self.device_id, since=since)

    def places(self, since: float) -> list[float]:
        """Where it was at each of its events, as `share` says it."""
        found = events(self.log, device_id=self.device_id, since=since)
        return [self.share(entry) for entry in found if entry.position_counts is not None]

    def set_off(self) -> Outcome:
        """The slow move, under way."""
        moving = Outcome(self.go)
        wait_until(lambda: moving.error or (self.travelled > 0.03 and self.truth.moving), "it is under way")
        assert moving.error is None
        return moving

    def strike(self, *orders: Order) -> None:
        for order in orders:
            match order:
                case Sick():
                    self.well = not order.on
                case Process():
                    [pid] = children("control")
                    os.kill(pid, signal.Signals[f"SIG{order.signal}"])
                case Dashboard():
                    ask(self.rig.sim.port, order.line, PATIENCE_S)
                case _:
                    self.rig.sim.do(order)

    def make_ready(self) -> None:
        """What has to be done before it moves."""
        self.provider.enable()

    def wait_for_exchanges(self, since: float) -> None:
        wait_until(lambda: len(self.exchanges(since)) >= _BEATS, "it is asked as usual")

    def fault(self) -> str | None:
        """The fault that ``state()`` reports; None while that is an error."""
        try:
            return str(self.provider.state().fault)
        except DeviceError:
            return None

    def recover(self, recovery: Recovery, since: float) -> None:
        if recovery is not Recovery.NOTHING:
            self.provider.enable()


class _Joint(Subject):
    goal_rad = 1.3
    provider: Motor

    def go(self) -> float:
        return self.provider.move_to(self.goal_rad, 0.3)

    def use(self) -> None:
        for goal_rad in (0.15, 0.0):
            assert abs(self.provider.move_to(goal_rad) - goal_rad) < 0.03

    def share(self, place: Any) -> float:
        return float(place.position_rad / self.goal_rad)


class Servo(_Joint):
    """A Dynamixel servo of a head."""

    def get(self) -> Motor:
        return self.robot.motor("neck.pan")

    def holds(self, since: float) -> list[LogEntry]:
        return writes(self.log, device_id=self.device_id, register="goal_position", since=since)

    def exchanges(self, since: float) -> list[LogEntry]:
        asked = instructions(self.log, "sync_read", since=since)
        return [entry for entry in asked if self.device_id in (entry.ids or (entry.device_id,))]

    def moves(self, since: float) -> list[LogEntry]:
        """A command to hold its position does not count."""
        here = self.truth.position_counts
        found = super().moves(since)
        return [
            entry
            for entry in found
            if entry.registers[-1] != "goal_position" or abs(goal_counts(entry) - here) > _HERE_COUNTS
        ]


class Drive(_Joint):
    """A CiA 402 drive of a leg."""

    goal_rad = 0.9

    def get(self) -> Motor:
        return self.robot.motor("leg.hip")

    def holds(self, since: float) -> list[LogEntry]:
        reported = self.rig.frames("rpdo1", HIP, since)
        return [entry for entry in reported if int.from_bytes(entry.data[:2], "little") & HALT]

    def exchanges(self, since: float) -> list[LogEntry]:
        return self.rig.frames("tpdo1", HIP, since)


class Hand(Subject):
    """A 2F-85."""

    device_id = 9
    ends = ("fault", "brown_out")

    def get(self) -> Any:
        gripper = self.robot.gripper("left.hand")
        gripper.activate()
        return gripper

    def make_ready(self) -> None:
        """It is activated."""

    def go(self) -> object:
        return self.provider.move_to(0.03, 0.02)

    def use(self) -> None:
        for width_m in (0.07, 0.085):
            assert abs(self.provider.move_to(width_m).width_m - width_m) < 0.001

    def share(self, place: Any) -> float:
        return float((0.085 - place.width_m) / 0.055)

    @property
    def truth(self) -> Any:
        return self.rig.truth

    def holds(self, since: float) -> list[LogEntry]:
        return [entry for entry in self.rig.writes(since) if not entry.moves]

    def exchanges(self, since: float) -> list[LogEntry]:
        return instructions(self.log, device_id=self.device_id, since=since)

    def recover(self, recovery: Recovery, since: float) -> None:
        if recovery is not Recovery.NOTHING:
            self.provider.activate()


class TailServo(_Joint):
    """A Feetech servo of a tail."""

    full_speed = 1620
    """In steps/s: the move is slower, and a command to hold has the joint's full speed."""

    def get(self) -> Motor:
        return self.robot.motor("tail.root")

    def holds(self, since: float) -> list[LogEntry]:
        reported = writes(self.log, device_id=self.device_id, register="goal_speed", since=since)
        return [entry for entry in reported if int.from_bytes(entry.data[5:7], "little") == self.full_speed]

    def exchanges(self, since: float) -> list[LogEntry]:
        asked = instructions(self.log, "sync_read", since=since)
        return [entry for entry in asked if self.device_id in entry.ids]

    def moves(self, since: float) -> list[LogEntry]:
        """A command to hold its position does not count."""
        here = self.truth.position_counts
        found = super().moves(since)
        return [
            entry
            for entry in found
            if "goal_position" not in entry.registers or abs(goal_of(entry) - here) > _HERE_COUNTS
        ]


class TailMotor(_Joint):
    """An ODrive, or a Damiao motor, of a tail."""

    goal_rad = 0.9

    def get(self) -> Motor:
        return self.robot.motor("tail.root")

    def holds(self, since: float) -> list[LogEntry]:
        return self.rig.frames(self.rig.target, ROOT, since)

    def exchanges(self, since: float) -> list[LogEntry]:
        return [entry for entry in self.rig.frames(device_id=ROOT, since=since) if entry.direction == "out"]

    def moves(self, since: float) -> list[LogEntry]:
        """A command to hold its position does not count."""
        here_rad = self.truth.position_rad * self.rig.robot.joints[0].gear
        return [entry for entry in super().moves(since) if not self._holds_at(entry, here_rad)]

    def _holds_at(self, entry: LogEntry, here_rad: float) -> bool:
        if entry.name != self.rig.target:
            return False
        [target] = struct.unpack("<f", entry.data[:4])
        return bool(abs(target * self.rig.unit_rad - here_rad) < 0.05)


class ArmSubject(Subject):
    """An arm of Universal Robots: of its joints the first one moves."""

    device_id = 0
    ends = ("program_stopped", "program_paused")

    def get(self) -> Arm:
        return self.robot.arm("right")

    def make_ready(self) -> None:
        """Control is taken by its first move."""
        self.use()

    def go(self) -> object:
        return self.provider.move_joints(FAR, SLOW)

    def use(self) -> None:
        for base_rad in (0.15, 0.0):
            assert abs(self.provider.move_joints([base_rad, *AT_HOME[1:]])[0] - base_rad) < 0.03

    def share(self, place: Any) -> float:
        return float(place.positions_rad[0] / FAR[0])

    @property
    def truth(self) -> Any:
        return self.rig.truth

    def places(self, since: float) -> list[float]:
        return [json.loads(e.detail)[0] / FAR[0] for e in events(self.log, since=since) if e.detail.startswith("[")]

    def holds(self, since: float) -> list[LogEntry]:
        return instructions(self.log, "stop_j", since=since)

    def exchanges(self, since: float) -> list[LogEntry]:
        raise NotImplementedError  # its answers are not in the log

    def wait_for_exchanges(self, since: float) -> None:
        measured: set[float] = set()

        def often() -> bool:
            if self.fault() is not None and (at := self.provider.state().measured_at) > since:
                measured.add(at)
            return len(measured) >= _BEATS

        wait_until(often, "it is read as usual")

    def recover(self, recovery: Recovery, since: float) -> None:
        if recovery is Recovery.UNLOCK:
            wait_until(self._unlocked, "its controller takes it")
        if recovery is Recovery.START:
            self.provider.power_on()
            self.provider.release_brakes()

    def _unlocked(self) -> bool:
        try:
            self.provider.unlock_protective_stop()
        except DeviceFault as refused:
            assert "Cannot unlock" in str(refused)
            return False
        return True


def _servo(tmp_path: Path, undo: ExitStack) -> Subject:
    rig = Rig(tmp_path, undo)
    rig.configure(('driver = "dynamixel"', f'driver = "dynamixel"\n{_PATIENT}\nwatchdog_s = 0.4'))
    rig.plug()
    return Servo(rig)


def _drive(_: Path, undo: ExitStack) -> Subject:
    rig = Leg(undo)
    rig.configure(('driver = "cia402"', f'driver = "cia402"\n{_PATIENT}\nwatchdog_s = 0.4'))
    rig.plug()
    return Drive(rig)


def _hand(tmp_path: Path, undo: ExitStack) -> Subject:
    rig = HandRig(tmp_path, undo)
    rig.configure(('driver = "robotiq"', f'driver = "robotiq"\n{_PATIENT}'))
    rig.plug()
    return Hand(rig)


def _tail(tmp_path: Path, undo: ExitStack) -> Subject:
    rig = TailRig(tmp_path, undo)
    rig.configure(('driver = "feetech"', f'driver = "feetech"\n{_PATIENT}\nwatchdog_s = 0.4'))
    rig.plug()
    return TailServo(rig)


def _motor(kind: str, undo: ExitStack) -> Subject:
    rig = KINDS[kind](undo)
    rig.plug()
    return TailMotor(rig)


SUBJECTS = {
    "dynamixel": _servo,
    "cia402": _drive,
    "robotiq": _hand,
    "feetech": _tail,
    "odrive": lambda _, undo: _motor("odrive", undo),
    "damiao": lambda _, undo: _motor("damiao", undo),
    "ur": lambda _, undo: ArmSubject(ArmRig(undo)),
}
"""What makes one of each kind."""
OWN_CLOCK = frozenset({"ur"})
"""Those whose library is in C++ and waits by itself, in processes of its own."""
