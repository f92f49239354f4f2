"""The truth about simulated devices, as the control socket tells it: what they do, whatever their answers say."""

import msgspec

__all__ = ["BusState", "DeviceState", "GripperTruth"]


class DeviceState(msgspec.Struct, frozen=True, kw_only=True):
    """One simulated device."""

    bus: str = ""
    device_id: int
    joint: str
    model: str
    position_counts: int
    position_rad: float
    """Joint angle in the robot file's sense; without a robot file, the device's angle from its centre."""
    velocity_rad_s: float
    goal_counts: int
    torque: bool
    moving: bool
    operating_mode: int
    hardware_error: int
    """Bits of its hardware error register."""
    watchdog: int
    """Dynamixel register 98: 0 off, 1 to 127 in units of 20 ms, 255 expired."""
    absent: bool


class GripperTruth(msgspec.Struct, frozen=True, kw_only=True):
    """One simulated gripper."""

    bus: str = ""
    device_id: int
    gripper: str
    width_m: float
    position_counts: int
    goal_counts: int
    activated: bool
    moving: bool
    holding: bool
    """It presses on something on its way to the goal."""
    force_n: float
    """The force it was told to press with."""
    fault: int
    """What its fault register reads."""
    absent: bool


class BusState(msgspec.Struct, frozen=True, kw_only=True):
    """One simulated bus."""

    name: str
    port: str
    """The name clients open."""
    plugged: bool
    devices: list[DeviceState] = []
    grippers: list[GripperTruth] = []
