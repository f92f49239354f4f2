"""The robots of stories: for each kind of wire a group of two joints, its simulator, and how its goals are read."""

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import tau
from typing import Any, Final

from tests.support.simulated_robots import HEAD, TAIL
from tests.unit.drivers.legs import COUNTS_PER_RAD, GO, HALT, LEG
from tests.unit.drivers.motor_rig import DAMIAO, ODRIVE
from trade_drivers import Robot, parse
from trade_hil_sim import DynamixelBus, LogEntry, motion_writes
from trade_hil_sim.cia402 import Cia402Bus
from trade_hil_sim.damiao import DamiaoBus
from trade_hil_sim.feetech import FeetechBus
from trade_hil_sim.odrive import OdriveBus

_BRAKES_RAD: Final = 0.15
"""From 2.5 rad/s at 20 rad/s^2: how far from where it rests the last set-point of a joint that is held may be."""

_CREEPS_S: Final = 1.0
"""A Dynamixel shows no speed below 0.036 rad/s: a slow joint has still 0.03 rad to go when it seems to rest."""


def _goal_register(entry: LogEntry) -> float | None:
    """Servos get a goal only while they move: where to does not matter."""
    return float("inf") if any("goal" in register for register in entry.registers) else None


def _cia402(entry: LogEntry) -> float | None:
    if entry.name != "rpdo1" or len(entry.data) < 6:
        return None
    word, counts = struct.unpack("<Hi", entry.data[:6])
    return counts / COUNTS_PER_RAD if word & GO and not word & HALT else None


def _odrive(entry: LogEntry) -> float | None:
    return struct.unpack("<f", entry.data[:4])[0] * tau if entry.name == "set_input_pos" else None


def _damiao(entry: LogEntry) -> float | None:
    return struct.unpack("<f", entry.data[:4])[0] if entry.name == "pos_vel" else None


@dataclass(frozen=True)
class RobotKind:
    """A robot with one group of two joints on one bus."""

    group: str
    text: str = field(repr=False)
    simulator: Any
    goal: Callable[[LogEntry], float | None]
    """The target of an instruction or frame in rad of the device's own shaft; None: it is no goal."""
    can: bool = False
    settles_s: float = 0.15
    """How long it may move after its driver has measured rest: a cycle."""

    @property
    def home(self) -> str:
        """The name of the container of its driver."""
        return self.group.replace(".", "-")

    @cached_property
    def robot(self) -> Robot:
        return parse(self.text, f"{self.group}.toml")

    @property
    def joints(self) -> list[str]:
        """The group of each joint."""
        return [f"{self.robot.name}.{joint.name}" for joint in self.robot.joints]

    def goals(self, log: Sequence[LogEntry], since: float, until: float) -> list[LogEntry]:
        """What leads a resting joint away from where it is."""
        if not self.can:
            return [one for one in motion_writes(log, since=since, until=until) if self.goal(one) is not None]
        sent = [one for one in log if since <= one.t <= until and one.kind == "frame" and one.direction == "in"]
        return [one for one in sent if self._leads_away(log, one)]

    def _leads_away(self, log: Sequence[LogEntry], entry: LogEntry) -> bool:
        shaft_rad = self.goal(entry)
        if shaft_rad is None:
            return False
        known = [one for one in log if one.device_id == entry.device_id and one.position_rad is not None]
        here = [one.position_rad for one in known if one.t <= entry.t]
        [joint] = [one for one in self.robot.joints if one.id == entry.device_id]
        gear = 1.0 if self.simulator is Cia402Bus else joint.gear
        target_rad = joint.offset_rad + (-1 if joint.reversed else 1) * shaft_rad / gear
        return bool(here) and abs(target_rad - here[-1]) > _BRAKES_RAD


KINDS: Final = {
    kind.group: kind
    for kind in (
        RobotKind("rosie.tail", TAIL, FeetechBus, _goal_register),
        RobotKind("rosie.head", HEAD, DynamixelBus, _goal_register, settles_s=_CREEPS_S),
        RobotKind("rosie.leg", LEG, Cia402Bus, _cia402, can=True),
        RobotKind("rosie.arm", ODRIVE.replace("tail", "arm"), OdriveBus, _odrive, can=True),
        RobotKind("rosie.hand", DAMIAO.replace("tail", "hand"), DamiaoBus, _damiao, can=True),
    )
}
