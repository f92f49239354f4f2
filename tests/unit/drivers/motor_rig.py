"""Two simulated motors of each kind that is asked one by one on a CAN bus, and the simulator's log as the judge."""

import struct
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from math import tau
from typing import Any, ClassVar

import pytest

from tests.unit.drivers.legs import Leg
from trade_hil_sim import LogEntry
from trade_hil_sim.damiao import DamiaoBus
from trade_hil_sim.odrive import OdriveBus

__all__ = ["DAMIAO", "KINDS", "ODRIVE", "ROOT", "TIP", "MotorRig", "motor_rig", "wag"]

ROOT, TIP = 1, 2
_JOINTS = """
[joint."tail.root"]
bus = "tail"
id = 1
model = "{model}"
gear = {gear}
min_rad = -1.0
max_rad = 1.0
max_speed_rad_s = 2.0
max_accel_rad_s2 = 20.0

[joint."tail.tip"]
bus = "tail"
id = 2
model = "{model}"
gear = {gear}
reversed = true
offset_rad = 0.2
min_rad = -1.0
max_rad = 1.0
max_speed_rad_s = 2.0
max_accel_rad_s2 = 20.0

[group.tail]
joints = ["tail.root", "tail.tip"]
"""
_BUS = """
[robot]
name = "rosie"

[bus.tail]
driver = "{driver}"
interface = "socketcan"
channel = "can0"
watchdog_s = 0.4
stale_after_s = 0.4
leave = "relax"
"""
ODRIVE = _BUS.format(driver="odrive") + _JOINTS.format(model="ODrive S1", gear='8\nzero = "last"')
DAMIAO = _BUS.format(driver="damiao") + _JOINTS.format(model="DM4310", gear="1.0")


class MotorRig(Leg):
    """The simulated bus and the driver attached to it."""

    kind: str
    file = "tail.toml"
    sim_class: ClassVar[type[Any]]
    orders: ClassVar[frozenset[str]]
    """Names of frames that could set a motor moving, or let go of it."""
    target: ClassVar[str]
    """The one that says where to."""

    def plug(self, *, prepare: Callable[[Any], None] = lambda _: None, paced: bool = False) -> Any:
        bus = self.robot.buses[0]
        return self.open(
            self.sim_class.from_robot(bus, self.robot.joints_on(bus.name), self._tmp_path, paced=paced), prepare
        )

    def commanded(self, device_id: int | None = None, since: float = 0.0) -> list[LogEntry]:
        """Every frame of a client that could move something, or keeps it where it is."""
        return [e for e in self.frames(device_id=device_id, since=since) if e.name in self.orders]

    def targets(self, device_id: int, since: float = 0.0) -> list[float]:
        """Where it was sent, in rad of its own shaft."""
        found = self.frames(self.target, device_id, since)
        return [struct.unpack("<f", e.data[:4])[0] * self.unit_rad for e in found]

    def sent_away(self, device_id: int, since: float, rad: float = 0.05) -> bool:
        """Whether it got a goal other than its position at its first command."""
        targets = self.targets(device_id, since)
        return any(abs(target - targets[0]) > rad for target in targets)

    unit_rad: ClassVar[float]


class OdriveRig(MotorRig):
    kind, original = "odrive", ODRIVE
    sim_class = OdriveBus
    orders = frozenset({"set_axis_state", "set_controller_mode", "set_input_pos", "set_input_vel", "set_input_torque"})
    target = "set_input_pos"
    unit_rad = tau


class DamiaoRig(MotorRig):
    kind, original = "damiao", DAMIAO
    sim_class = DamiaoBus
    orders = frozenset({"enable", "disable", "clear_error", "set_zero", "mit", "pos_vel", "vel", "force_pos"})
    target = "pos_vel"
    unit_rad = 1.0


KINDS: dict[str, type[MotorRig]] = {"odrive": OdriveRig, "damiao": DamiaoRig}


@pytest.fixture(params=list(KINDS))
def motor_rig(request: pytest.FixtureRequest) -> Iterator[MotorRig]:
    with ExitStack() as undo:
        yield KINDS[request.param](undo)


@pytest.fixture
def wag(motor_rig: MotorRig) -> MotorRig:
    """A plugged-in tail."""
    motor_rig.plug()
    return motor_rig
