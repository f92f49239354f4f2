"""Records of the robot file: buses, devices, groups and the robot of them. No I/O."""

from collections.abc import Mapping
from math import isfinite
from typing import Annotated, Literal, TypeVar

from msgspec import Meta, Struct

from trade_robotfile._convert import record_of

Text = Annotated[str, Meta(min_length=1)]
Positive = Annotated[float, Meta(gt=0)]
Angles = Annotated[list[float], Meta(min_length=6, max_length=6)]


class Gripper(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One gripper: its device on a bus, and its limits."""

    name: str
    bus: str
    id: Annotated[int, Meta(ge=1, le=247)]
    """Modbus slave id; a 2F-85 leaves the factory with 9."""
    model: str
    """Model as printed on the device: ``2F-85``."""
    min_width_m: Annotated[float, Meta(ge=0)] = 0.0
    max_width_m: Positive
    max_speed_m_s: Positive
    max_force_n: Positive


class Arm(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One arm of six joints: its controller, its limits, and its named poses."""

    name: str
    bus: str
    model: str
    """Model as printed on the device: ``UR5e``."""
    min_rad: Angles
    """Limit of each joint, from the base to the tool."""
    max_rad: Angles
    max_speed_rad_s: Positive
    """Limit of all joints."""
    max_accel_rad_s2: Positive
    max_speed_m_s: Positive
    """Limit of the tool, on a straight line."""
    max_accel_m_s2: Positive
    poses: dict[str, Angles] = {}
    """Joint angles in rad by name, such as ``home``."""


_Options = TypeVar("_Options", bound=Struct)


class _Sense(Struct, frozen=True, kw_only=True):
    """A device that only observes: its driver, and the driver's options."""

    name: str
    driver: str
    """Entry point of the group ``trade.drivers``: ``snapshot``."""
    options: Mapping[str, object]
    """The other keys of its table, which the driver defines."""
    key: str
    """The key of its table: ``camera.eye``."""
    where: str
    """The file of the table."""

    def options_as(self, record: type[_Options]) -> _Options:
        """Returns the options as a record of the driver, which should forbid unknown fields.

        Raises:
            RobotFileError: a key is missing, unknown or wrong; names file, key, value and the valid values.
        """
        return record_of(self.key, None, self.options, record, self.where)


class Camera(_Sense, frozen=True, kw_only=True):
    """One camera."""


class Sensor(_Sense, frozen=True, kw_only=True):
    """One sensor."""


class Group(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Joints that move together, in the order of all values."""

    name: str
    joints: Annotated[list[str], Meta(min_length=1)]


class Coupled(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Joints that can collide, so that none is locked without the others."""

    joints: Annotated[list[str], Meta(min_length=2)]


class Drill(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Maximum time to rest in seconds after each action of `trade drill`; None: the default of the safety rules."""

    caller_killed: Positive | None = None
    caller_frozen: Positive | None = None
    stream_frozen: Positive | None = None
    gateway_killed: Positive | None = None
    partition: Positive | None = None
    driver_killed: Positive | None = None
    driver_frozen: Positive | None = None
    unplug: Positive | None = None
    bus_off: Positive | None = None


def arm_problem(arm: Arm) -> tuple[str, str] | None:
    """Returns the key of an arm with a wrong value, and the reason; None if there is none."""
    for key, values in (("min_rad", arm.min_rad), ("max_rad", arm.max_rad), *arm.poses.items()):
        if not all(isfinite(value) for value in values):
            return key, f"must be finite numbers, but it is {values}"
    for joint, (low, high) in enumerate(zip(arm.min_rad, arm.max_rad, strict=True)):
        if not low < high:
            return "max_rad", f"must be greater than min_rad, but for joint {joint} {high} <= {low}"
    for name, angles in arm.poses.items():
        for joint, (low, angle, high) in enumerate(zip(arm.min_rad, angles, arm.max_rad, strict=True)):
            if not low <= angle <= high:
                return f"poses.{name}", f"{angle} of joint {joint} is outside of {low} to {high}"
    return None


class Bus(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One bus: the settings of all kinds of buses."""

    name: str
    driver: str
    """Entry point of the group ``trade.drivers``: ``dynamixel``."""
    rate_hz: Annotated[float, Meta(gt=0, le=1000)] = 100.0
    """Cycles of reading and writing per second."""
    stale_after_s: Annotated[float, Meta(gt=0, le=2)] = 0.25
    """The age from which a measurement is an error."""
    watchdog_s: Annotated[float, Meta(ge=0.1, le=2)] = 0.3
    """The timeout of the device's own watchdog. A device without one is never commanded farther ahead than this."""
    leave: Literal["hold", "relax"] = "hold"
    """What the driver does with enabled devices at shutdown: hold the position, or switch torque off."""
    process: Literal["shared", "own"] = "shared"
    """Whether ``trade up`` runs it in the robot's process, or in one of its own that no other bus or code delays."""


class SerialBus(Bus, frozen=True, kw_only=True):
    """A serial line."""

    port: Text
    """Serial device; prefer the stable name under /dev/serial/by-id."""
    baud: Annotated[int, Meta(ge=9600, le=4_500_000)] = 1_000_000
    fast_sync: bool = False
    """Read all devices with one combined answer (needs firmware support)."""


class CanBus(Bus, frozen=True, kw_only=True):
    """A CAN bus, with the names of python-can."""

    interface: Annotated[str, Meta(pattern="^[a-z0-9_]+$")]
    """``socketcan``, ``socketcand``, ``slcan``, ``virtual`` or another one of python-can except ``udp_multicast``."""
    channel: Text
    """``can0`` for socketcan, ``HOST:PORT/can0`` for socketcand, the serial device for slcan."""
    bitrate: Annotated[int, Meta(ge=10_000, le=1_000_000)] = 1_000_000
    """Bits per second. Must match the rate that the operating system sets for its own interfaces."""

    @property
    def port(self) -> str:
        """Interface and channel as one text, such as ``socketcan:can0``."""
        return f"{self.interface}:{self.channel}"


class UrBus(Bus, frozen=True, kw_only=True):
    """The controller of a Universal Robots arm, on the network."""

    host: Text
    """Host name or address; the ports are fixed."""
    rate_hz: Annotated[float, Meta(ge=0, le=500)] = 0.0
    """Set-points per second; 0: one per cycle of the controller, 500 or (CB3) 125."""

    @property
    def port(self) -> str:
        """The host."""
        return self.host


class Joint(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One joint: its device on a bus, its zero and its limits."""

    name: str
    bus: str
    id: Annotated[int, Meta(ge=0, le=252)]
    model: str
    """Model as printed on the device: ``XL430-W250``."""
    firmware: str | None = None
    """Firmware version that the device must report. Not checked if left out."""
    serial_number: Annotated[int, Meta(ge=0)] | None = None
    """Serial number that the device must report. Not checked if left out."""
    reversed: bool = False
    homing_counts: int = 0
    """The servo's homing offset at calibration. Another one is refused, as the zero has moved."""
    offset_rad: float = 0.0
    """Joint angle when the device reads its centre, or 0 where counts have no centre."""
    counts_per_rev: Positive | None = None
    """Encoder counts per turn of the motor, for devices whose model does not determine them."""
    gear: Positive = 1.0
    """Turns of the motor per turn of the joint."""
    zero: Literal["last", "kept"] | None = None
    """How its zero is known after a loss of power: by its last known angle, or because the device keeps or finds it."""
    min_rad: float
    max_rad: float
    max_speed_rad_s: Positive
    max_accel_rad_s2: Positive


class Robot(Struct, frozen=True, kw_only=True):
    """A parsed and checked robot file."""

    name: str
    buses: list[SerialBus | CanBus | UrBus]
    joints: list[Joint]
    groups: list[Group]
    coupled: list[Coupled]
    where: str
    """The file the robot was read from."""
    grippers: list[Gripper] = []
    arms: list[Arm] = []
    cameras: list[Camera] = []
    sensors: list[Sensor] = []
    drill: Drill = Drill()
    given: dict[str, list[str]] = {}
    """The keys in each bus's table, so that a driver can refuse those it does not use."""

    def joints_on(self, bus: str) -> list[Joint]:
        """Returns the joints on one bus, in file order."""
        return [joint for joint in self.joints if joint.bus == bus]

    def grippers_on(self, bus: str) -> list[Gripper]:
        """Returns the grippers on one bus, in file order."""
        return [gripper for gripper in self.grippers if gripper.bus == bus]

    def arms_on(self, bus: str) -> list[Arm]:
        """Returns the arms on one bus, in file order."""
        return [arm for arm in self.arms if arm.bus == bus]

    def own_processes(self) -> list[str]:
        """Returns the buses that need a process besides the one for the rest of the robot.

        If each bus with a device has a process of its own, the first one is the rest.
        """
        devices = (*self.joints, *self.grippers, *self.arms)
        used = {device.bus for device in devices}
        own = [bus.name for bus in self.buses if bus.process == "own" and bus.name in used]
        shared = used.difference(own) or self.cameras or self.sensors
        return own if shared else own[1:]

    def coupled_to(self, joint: str) -> list[str]:
        """Returns the full names of the joints that are only locked together with this one."""
        names = dict.fromkeys(name for pair in self.coupled if joint in pair.joints for name in pair.joints)
        return [f"{self.name}.{name}" for name in names if name != joint]

    def members(self) -> dict[str, list[str]]:
        """Returns the devices of the robot, of its groups and of each prefix of their names, with full names.

        A lock of one of these covers all of its members, or none.
        """
        found: dict[str, dict[str, None]] = {}
        for device in (*self.joints, *self.grippers, *self.arms):
            full = f"{self.name}.{device.name}"
            for end, letter in enumerate(full):
                if letter == ".":
                    found.setdefault(full[:end], {})[full] = None
        for group in self.groups:
            joints = found.setdefault(f"{self.name}.{group.name}", {})
            joints.update(dict.fromkeys(f"{self.name}.{joint}" for joint in group.joints))
        return {group: list(joints) for group, joints in found.items()}
