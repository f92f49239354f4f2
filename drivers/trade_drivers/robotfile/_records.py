"""Records of the robot file for grippers, arms, cameras, sensors and groups. No I/O."""

from collections.abc import Mapping
from math import isfinite
from typing import Annotated, TypeVar

from msgspec import Meta, Struct

from trade_drivers.robotfile._convert import record_of

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
            ConfigurationError: a key is missing, unknown or wrong; names file, key, value and the valid values.
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
