"""Looking a bus over before anything may be commanded: who is there, and set how. Moves nothing and resets nothing."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final, NoReturn

from trade.errors import ConfigurationError
from trade_drivers.joints.serial import (
    again,
    check_firmware,
    check_homing,
    check_model,
    check_ranges,
    check_rate,
    first_ping,
)
from trade_drivers.vendors.feetech import _table as table
from trade_drivers.vendors.feetech._axis import CYCLIC, SLOW, FeetechAxis
from trade_drivers.vendors.feetech._frames import OVERHEAD
from trade_drivers.vendors.feetech._jobs import GOAL_BLOCK

if TYPE_CHECKING:
    from trade_drivers.joints.serial._wire import ServoWire
    from trade_drivers.robotfile import Robot, SerialBus

__all__ = ["check_bus", "look_over"]

_EEPROM: Final = (0, table.TORQUE.address)
_MOST_SPEED_COUNTS: Final = ((1 << 15) - 1) // table.STEPS_PER_SPEED


def check_bus(robot: "Robot", bus: "SerialBus", axes: Sequence[FeetechAxis]) -> None:
    """What the file alone can tell: speeds, keys, and whether the bytes of a cycle fit into it.

    Raises:
        ConfigurationError: names the key and what would be right.
    """
    where = robot.where
    if "fast_sync" in robot.given.get(bus.name, ()):
        _wrong(f"{where}: bus.{bus.name}.fast_sync", "these servos have no joined answers; leave this key out")
    for axis in axes:
        check_ranges(axis, where)
        joint = axis.joint
        for key, value, most in (
            ("max_speed_rad_s", joint.max_speed_rad_s, _MOST_SPEED_COUNTS * table.RAD_S_PER_COUNT),
            ("max_accel_rad_s2", joint.max_accel_rad_s2, table.MOST_ACCELERATION * table.RAD_S2_PER_COUNT),
        ):
            if value > most:
                problem = f"{value:.4g} is above {most:.4g}, the most an {joint.model} can be set to"
                _wrong(f'{where}: joint."{joint.name}".{key}', problem)
    count = len(axes)
    asked = OVERHEAD + 2 + count + count * (OVERHEAD + CYCLIC[1])
    check_rate(bus, count, asked + OVERHEAD + 2 + count * (1 + GOAL_BLOCK[1]), where)


def look_over(wire: "ServoWire", bus: "SerialBus", axis: FeetechAxis, clock_ns: Callable[[], int], where: str) -> None:
    """Check one joint's device and take its first measurements.

    Raises:
        ConfigurationError: it is absent, another model, set wrongly, or not alone under its id.
    """
    key = f'{where}: joint."{axis.joint.name}"'
    number = first_ping(wire, bus, axis, key, (5, 6))
    check_model(axis, number, table.name_of(number, "a model this driver does not know"), key)
    asked_ns = clock_ns()
    settings = again(wire, axis, lambda: wire.read(axis.id, *_EEPROM).data)
    health = again(wire, axis, lambda: wire.read(axis.id, *SLOW).data)
    sample = again(wire, axis, lambda: wire.read(axis.id, *CYCLIC).data)
    check_firmware(axis, table.firmware(settings), key)
    check_homing(axis, settings, key)
    axis.unload = table.UNLOAD.decode(settings)
    axis.take_health(health, asked_ns)
    axis.take_sample(sample, asked_ns)
    _check_settings(axis, settings, key)


def _check_settings(axis: FeetechAxis, settings: bytes, key: str) -> None:
    joint, phase = axis.joint, table.PHASE.decode(settings)
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
    low, high = table.MIN_ANGLE.decode(settings), table.MAX_ANGLE.decode(settings)
    if low == high == 0:
        _wrong(key, "its range (registers 9 and 11) is 0 to 0, which is many turns; set it to 0 and 4095")
    if axis.low < low or axis.high > high:
        ends = sorted((axis.scale.angle_rad(low), axis.scale.angle_rad(high)))
        _wrong(
            key,
            f"min_rad {joint.min_rad:.6g} to max_rad {joint.max_rad:.6g} is more than the device's own range "
            f"(registers 9 and 11), {ends[0]:.6g} to {ends[1]:.6g} rad; narrow the one or widen the other",
        )


def _wrong(where: str, problem: str) -> NoReturn:
    raise ConfigurationError(where=where, problem=problem)
