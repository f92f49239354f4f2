"""The truth about simulated devices, as the control socket tells it: what they do, whatever their answers say."""

import msgspec

__all__ = ["ArmTruth", "BusState", "DeviceState", "GripperTruth"]


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
    object_m: float | None = None
    """How wide the object is that was put between its fingers; None: there is none."""
    force_n: float
    """The force it was told to press with."""
    fault: int
    """What its fault register reads."""
    absent: bool


class ArmTruth(msgspec.Struct, frozen=True, kw_only=True):
    """One simulated arm with its controller."""

    bus: str = ""
    device_id: int
    arm: str
    model: str
    positions_rad: list[float]
    velocities_rad_s: list[float]
    pose: list[float]
    """Of its flange: x, y, z in m, and a rotation vector in rad."""
    moving: bool
    robot_mode: str
    safety_mode: str
    program: str
    """``control``: the script of its driver runs; ``played``: one of its own; empty: none."""
    freedrive: bool
    speed_fraction: float
    watchdog_hz: float
    """How often it has to hear from the host; 0: not armed."""
    absent: bool


class BusState(msgspec.Struct, frozen=True, kw_only=True):
    """One simulated bus."""

    name: str
    port: str
    """The name clients open."""
    plugged: bool
    devices: list[DeviceState] = []
    grippers: list[GripperTruth] = []
    arms: list[ArmTruth] = []
