"""The true state of simulated devices, as the control socket reports it, whatever their answers say."""

import msgspec


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
    """It presses on an object on its way to the goal."""
    object_m: float | None = None
    """Width of the object between its fingers; None without one."""
    force_n: float
    """The commanded force."""
    fault: int
    """Value of its fault register."""
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
    """Pose of its flange: x, y, z in m, and a rotation vector in rad."""
    moving: bool
    robot_mode: str
    safety_mode: str
    program: str
    """``control``: the script of its driver runs; ``played``: one of its own; empty: none."""
    freedrive: bool
    speed_fraction: float
    watchdog_hz: float
    """The lowest rate at which the host must send; 0: not armed."""
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
