"""Checks of devices and their settings before anything may be commanded. Moves and resets nothing."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final, NoReturn

from trade.errors import ConfigurationError
from trade_drivers.joints import check_joints
from trade_drivers.joints.serial import Kept, NoAnswer, check_cycle, check_own_range, check_ranges, first_look
from trade_drivers.vendors.dynamixel import _table as table
from trade_drivers.vendors.dynamixel._axis import CYCLIC, DynamixelAxis

if TYPE_CHECKING:
    from trade_drivers.vendors.dynamixel._wire import Wire
    from trade_robotfile import SerialBus

_KEPT: Final = Kept((7, 8), table.name_of, table.firmware)
_OTHER_THAN_REVERSED: Final = 0xFE
_SHADOWS: Final = 252
_ALL_ANSWER: Final = 2


def check_bus(bus: "SerialBus", axes: Sequence[DynamixelAxis], where: str) -> None:
    """Checks the robot file: speeds, and whether a cycle is long enough for its bytes.

    Raises:
        ConfigurationError: a check failed; names the key and the right value.
    """
    check_joints(axes, where, check_ranges)
    count = len(axes)
    read = 14 + count + (8 + count * 14 if bus.fast_sync else count * (11 + CYCLIC[1]))
    check_cycle(bus, count, read + 14 + count * 5, where)


def look_over(wire: "Wire", bus: "SerialBus", axis: DynamixelAxis, clock_ns: Callable[[], int], where: str) -> float:
    """Checks one joint's device and takes its first measurements.

    Returns:
        The return delay in seconds, which only reduces speed.

    Raises:
        ConfigurationError: the device is absent, another model, set wrongly, or shares its id.
    """
    key = f'{where}: joint."{axis.joint.name}"'
    try:
        settings = first_look(wire, bus, axis, _KEPT, clock_ns, key)
    except NoAnswer:
        silent = "it answers a ping but no read: its status return level (68) is 0 or 1; set it to 2"
        raise ConfigurationError(where=key, problem=silent) from None
    check_settings(axis, settings, key)
    return table.RETURN_DELAY.decode(settings) * table.RETURN_DELAY.si_per_count


def check_settings(axis: DynamixelAxis, settings: bytes, key: str) -> None:
    """Compares the persistent registers with the robot file. Raises ``ConfigurationError``."""
    joint, health = axis.joint, axis.health
    mode, drive = table.OPERATING_MODE.decode(settings), table.DRIVE_MODE.decode(settings)
    if health is not None and health.status_level != _ALL_ANSWER:
        _wrong(key, f"its status return level (register 68) is {health.status_level}; set it to 2")
    if mode != table.POSITION_MODE:
        _wrong(key, f"its operating mode (register 11) is {mode}; set it to 3, position control, with torque off")
    if drive & _OTHER_THAN_REVERSED:
        problem = f"its drive mode (register 10) is {drive}; set it to 0, with torque off: speeds as velocities"
        _wrong(key, f"{problem}, torque switched on by nothing but us")
    if drive:
        problem = f"its drive mode (register 10) is {drive}: it counts in the other direction by itself, and the file"
        _wrong(key, f"{problem} has reversed = {str(joint.reversed).lower()}; set it to 0, use reversed, and calibrate")
    if (shadow := table.SHADOW_ID.decode(settings)) <= _SHADOWS:
        _wrong(key, f"it also obeys what is sent to id {shadow} (register 12); set it to 255, with torque off")
    check_own_range(axis, settings, key)
    fastest = table.VELOCITY_LIMIT.decode(settings)
    if axis.speed_counts > fastest:
        limit = fastest * table.RAD_S_PER_COUNT
        _wrong(
            f"{key}.max_speed_rad_s",
            f"{joint.max_speed_rad_s:.6g} is above the device's own limit {limit:.4g} (register 44)",
        )


def _wrong(where: str, problem: str) -> NoReturn:
    raise ConfigurationError(where=where, problem=problem)
