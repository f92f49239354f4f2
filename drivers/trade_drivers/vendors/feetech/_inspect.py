"""Checks of devices and their settings before anything may be commanded. Moves and resets nothing."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final, NoReturn

from trade.errors import ConfigurationError
from trade_drivers.joints import Unfit, check_joints
from trade_drivers.joints.serial import Kept, check_cycle, check_own_range, check_ranges, first_look
from trade_drivers.vendors.feetech import _table as table
from trade_drivers.vendors.feetech._axis import CYCLIC, FeetechAxis
from trade_drivers.vendors.feetech._frames import OVERHEAD
from trade_drivers.vendors.feetech._jobs import GOAL_BLOCK

if TYPE_CHECKING:
    from trade_drivers.joints.serial._wire import ServoWire
    from trade_robotfile import Robot, SerialBus

_KEPT: Final = Kept((5, 6), table.name_of, table.firmware)
_MOST_SPEED_COUNTS: Final = ((1 << 15) - 1) // table.STEPS_PER_SPEED


def check_bus(robot: "Robot", bus: "SerialBus", axes: Sequence[FeetechAxis]) -> None:
    """Checks the robot file: speeds, keys, and whether a cycle is long enough for its bytes.

    Raises:
        ConfigurationError: a check failed; names the key and the right value.
    """
    where = robot.where
    if "fast_sync" in robot.given.get(bus.name, ()):
        _wrong(f"{where}: bus.{bus.name}.fast_sync", "these servos have no joined answers; leave this key out")
    check_joints(axes, where, check_ranges)
    check_joints(axes, where, _check_most)
    count = len(axes)
    asked = OVERHEAD + 2 + count + count * (OVERHEAD + CYCLIC[1])
    check_cycle(bus, count, asked + OVERHEAD + 2 + count * (1 + GOAL_BLOCK[1]), where)


def _check_most(axis: FeetechAxis) -> None:
    joint = axis.joint
    for key, value, most in (
        (".max_speed_rad_s", joint.max_speed_rad_s, _MOST_SPEED_COUNTS * table.RAD_S_PER_COUNT),
        (".max_accel_rad_s2", joint.max_accel_rad_s2, table.MOST_ACCELERATION * table.RAD_S2_PER_COUNT),
    ):
        if value > most:
            raise Unfit(f"{value:.4g} is above {most:.4g}, the most an {joint.model} can be set to", key)


def look_over(wire: "ServoWire", bus: "SerialBus", axis: FeetechAxis, clock_ns: Callable[[], int], where: str) -> None:
    """Checks one joint's device and takes its first measurements.

    Raises:
        ConfigurationError: the device is absent, another model, set wrongly, or shares its id.
    """
    key = f'{where}: joint."{axis.joint.name}"'
    settings = first_look(wire, bus, axis, _KEPT, clock_ns, key)
    check_settings(axis, settings, key)


def check_settings(axis: FeetechAxis, settings: bytes, key: str) -> None:
    """Compares the persistent registers with the robot file. Raises ``ConfigurationError``."""
    axis.unload = table.UNLOAD.decode(settings)
    phase = table.PHASE.decode(settings)
    if table.END.decode(settings) != 0:
        _wrong(key, "its words have their high byte first (register 2): it is no servo of the STS series")
    if table.STATUS_LEVEL.decode(settings) != 1:
        _wrong(key, "its status level (register 8) is 0: it answers no write; set it to 1")
    if (mode := table.MODE.decode(settings)) != table.POSITION_MODE:
        _wrong(key, f"its mode (register 33) is {mode}; set it to 0, position control, with torque off")
    if not phase & table.SPEED_IN_STEPS:
        _wrong(key, f"its phase (register 18) is {phase}: speeds are in units of 0.732 rpm; set bit 2")
    if phase & table.FULL_TURNS:
        _wrong(key, f"its phase (register 18) is {phase}: positions count whole turns; clear bit 4")
    if phase & table.DIRECTIONS:
        problem = f"its phase (register 18) is {phase}: it turns or counts in the other direction by itself, and the"
        stated = f"file has reversed = {str(axis.joint.reversed).lower()}"
        _wrong(key, f"{problem} {stated}; clear bits 0 and 7, use reversed, and calibrate")
    low, high = table.MIN_ANGLE.decode(settings), table.MAX_ANGLE.decode(settings)
    if low == high == 0:
        _wrong(key, "its range (registers 9 and 11) is 0 to 0, which is many turns; set it to 0 and 4095")
    check_own_range(axis, settings, key)


def _wrong(where: str, problem: str) -> NoReturn:
    raise ConfigurationError(where=where, problem=problem)
