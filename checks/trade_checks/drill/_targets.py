"""The joints that a drill moves: on each bus the one with the widest range, preferably not coupled, or the arm."""

from collections.abc import Sequence

from msgspec import Struct

from trade_drivers import Driver, load_driver
from trade_robotfile import Arm, Bus, CanBus, Joint, Robot

LASTS_S = 20.0
"""How long a motion of a drill would last if nothing ended it, in seconds."""
_STREAMS_S = 2.5
"""Shortest time until a stream stops and its last set-point expires, on a busy computer, in seconds."""
_MARGIN = 0.05
"""The fraction of its range that a joint keeps free at either end."""


class Target(Struct, frozen=True, kw_only=True):
    """One joint, or the first joint of an arm, that moves in a drill."""

    name: str
    """Its name in the robot file."""
    group: str
    """The group of its services: ``rosie.neck.pan``."""
    bus: str
    can: bool
    """Whether its bus is a CAN bus."""
    arm: bool
    min_rad: float
    max_rad: float
    max_speed_rad_s: float
    max_accel_rad_s2: float
    watchdog_s: float
    """After this silence of the driver, its device stops by itself or has reached its last goal, in seconds."""

    @property
    def brakes_s(self) -> float:
        """How long it takes to brake from its greatest speed, in seconds."""
        return self.max_speed_rad_s / self.max_accel_rad_s2

    @property
    def streams(self) -> bool:
        """Whether it still moves when a stream of set-points stops: an arm moves as fast as it may."""
        shortest = (0.5 - _MARGIN) * (self.max_rad - self.min_rad)
        return not self.arm or shortest / self.max_speed_rad_s > _STREAMS_S

    def way(self, angle_rad: float) -> tuple[float, float]:
        """The goal and speed of a motion from an angle that lasts `LASTS_S`, in rad and rad/s."""
        margin = _MARGIN * (self.max_rad - self.min_rad)
        ends = (self.min_rad + margin, self.max_rad - margin)
        goal = max(ends, key=lambda end: abs(end - angle_rad))
        return goal, min(self.max_speed_rad_s, abs(goal - angle_rad) / LASTS_S)


def targets_of(robot: Robot) -> tuple[list[Target], dict[str, str]]:
    """Returns what moves in a drill, one target on each bus, and why other parts do not."""
    coupled = {joint for pair in robot.coupled for joint in pair.joints}
    found: list[Target] = []
    left_out: dict[str, str] = {}
    for bus in robot.buses:
        target = _target(robot, bus, coupled)
        if isinstance(target, Target):
            found.append(target)
        else:
            left_out[bus.name] = target
    for sense in (*robot.cameras, *robot.sensors):
        left_out[sense.name] = "it moves nothing"
    return found, left_out


def _target(robot: Robot, bus: Bus, coupled: set[str]) -> Target | str:
    """Returns the target on a bus, or why there is none."""
    if missing := load_driver(bus.driver, bus.name, Driver).missing():
        return f"its driver needs {', '.join(missing)}"
    for arm in robot.arms_on(bus.name):
        return _of(robot, bus, arm, (arm.min_rad[0], arm.max_rad[0]))
    if joints := robot.joints_on(bus.name):
        chosen = max(joints, key=lambda joint: (joint.name not in coupled, joint.max_rad - joint.min_rad))
        return _of(robot, bus, chosen, (chosen.min_rad, chosen.max_rad))
    return "a gripper ends its stroke by itself"


def _of(robot: Robot, bus: Bus, device: Joint | Arm, ends: Sequence[float]) -> Target:
    return Target(
        name=device.name,
        group=f"{robot.name}.{device.name}",
        bus=bus.name,
        can=isinstance(bus, CanBus),
        arm=isinstance(device, Arm),
        min_rad=ends[0],
        max_rad=ends[1],
        max_speed_rad_s=device.max_speed_rad_s,
        max_accel_rad_s2=device.max_accel_rad_s2,
        watchdog_s=bus.watchdog_s,
    )
