"""What a drive says about its scale and its units, compared with the robot file (S23). Reads only.

Sources: CiA 402-2 (608Fh to 6092h, 60A8h to 60AAh) and CiA 303-2 (units). C0h in 60AAh is the rpm of Maxon's EPOS4.
"""

from math import isclose, tau
from typing import Final, NamedTuple

from msgspec.structs import replace

from trade_drivers.joints import DeviceUnusable, Steps, check_least
from trade_drivers.joints.can import STILL_RAD_S
from trade_drivers.vendors.cia402 import _table as table
from trade_drivers.vendors.cia402._axis import DriveAxis
from trade_drivers.vendors.cia402._table import DictionaryEntry
from trade_drivers.vendors.cia402._wire import Answer, DriveRefused, Net

_SAME: Final = 1e-6
_LARGEST: Final = 2**31 - 1
_INCREMENT: Final = 0xB5
_TURN, _RPM = 0xB4, 0xC0
_ANGLES: Final = {0x10: 1.0, 0x41: tau / 360, 0x42: tau / 21_600, 0x43: tau / 1_296_000, _TURN: tau}
_SECOND, _MINUTE, _SECOND_SQUARED = 0x03, 0x47, 0x57
_PER_SPEED: Final = {(_SECOND, 0): 1.0, (_MINUTE, 0): 60.0}
_PER_ACCELERATION: Final = {
    (_SECOND, 0): 1.0,
    (_SECOND_SQUARED, 0): 1.0,
    (_SECOND, _SECOND): 1.0,
    (_MINUTE, _SECOND): 60.0,
}
"""The bytes of a denominator; manufacturers write s^2 as s, too."""
_NAMES: Final = {
    0x00: "",
    0x01: "m",
    _SECOND: "s",
    0x10: "rad",
    0x41: "deg",
    0x42: "arcmin",
    0x43: "arcsec",
    _MINUTE: "min",
    0x48: "h",
    _SECOND_SQUARED: "s^2",
    _TURN: "rev",
    _INCREMENT: "inc",
    _RPM: "rpm",
}


class Scale(NamedTuple):
    """What a drive says about the counts of its positions."""

    counts_per_rev: float | None
    """Counts for one turn of the motor; None if it says nothing."""
    source: str
    """The objects that say it, with their values."""
    gear: float
    """Turns of the motor for one of the shaft, which angles refer to."""
    counts_per_increment: float
    """0 if its positions have another unit."""


def check_units(net: Net, axis: DriveAxis) -> Steps:
    """Compares a drive's scale with the robot file, and uses the drive's own units of speed and acceleration.

    Raises:
        Unfit: the scale is another one, or a unit cannot be converted.
        NoAnswer: the drive does not answer.
    """
    joint = axis.joint
    scale = yield from read_scale(net, axis.id)
    counts = joint.counts_per_rev or 1.0  # checked when the file was
    if scale.counts_per_rev is not None and not isclose(scale.counts_per_rev, counts, rel_tol=_SAME):
        raise DeviceUnusable(
            f"the robot file has {counts:.9g} counts for a turn of the motor, the drive {scale.counts_per_rev:.9g} "
            f"({scale.source}); correct the one that is wrong",
            ".counts_per_rev",
        )
    polarity = yield from read_optional(net, axis.id, table.POLARITY)
    if polarity and polarity & table.REVERSED:
        raise DeviceUnusable(
            f"its polarity (607Eh) is {polarity:02X}h: it counts in the other direction by itself, and the file has "
            f"reversed = {str(joint.reversed).lower()}; set 607Eh to 0, and measure its direction and zero again",
            ".reversed",
        )
    speed = yield from read_optional(net, axis.id, table.VELOCITY_UNIT)
    accel = yield from read_optional(net, axis.id, table.ACCELERATION_UNIT)
    rad = axis.resolution.rad
    rad_s = rad if speed is None else _unit_in_rad(axis, scale, table.VELOCITY_UNIT, speed)
    rad_s2 = rad if accel is None else _unit_in_rad(axis, scale, table.ACCELERATION_UNIT, accel)
    for missing, unit, other, converted in (
        (table.ACCELERATION_UNIT, accel, table.VELOCITY_UNIT, rad_s),
        (table.VELOCITY_UNIT, speed, table.ACCELERATION_UNIT, rad_s2),
    ):
        if unit is None and not isclose(converted, rad):
            raise DeviceUnusable(f"it has a unit of its own in {other}, but no {missing}: that unit is unknown")
    still = max(1, round(STILL_RAD_S / rad_s))
    axis.use(replace(axis.resolution, rad_s=rad_s, rad_s2=rad_s2, still_velocity=still))
    check_least(axis, "one of the drive's own unit (60A9h, 60AAh)")
    if max(axis.speed_counts, axis.accel_counts) > _LARGEST:
        raise DeviceUnusable(
            "its speed or acceleration does not fit into 32 bits of the drive's own unit (60A9h, 60AAh)"
        )


def read_scale(net: Net, node: int) -> Answer[Scale]:
    """Reads the counts for a turn of the motor: from the position's unit, the feed, or the encoder.

    Raises:
        Unfit: what the drive says is impossible, or its unit cannot be converted to an angle.
    """
    unit = yield from read_optional(net, node, table.POSITION_UNIT)
    encoder = yield from _ratio(net, node, table.ENCODER)
    ratio = yield from _ratio(net, node, table.GEAR_RATIO)
    feed = yield from _ratio(net, node, table.FEED)
    gear, of_gear = ratio or (1.0, "")
    power, counted, *rest = (unit if unit is not None else _INCREMENT << 16).to_bytes(4, "big")
    one = 10.0 ** _signed(power)
    if any(rest) or counted not in {_INCREMENT, *_ANGLES}:
        raise _unusable(table.POSITION_UNIT, unit or 0, "an angle")
    if counted != _INCREMENT:
        return Scale(tau / _ANGLES[counted] / one / gear, _join(f"60A8h = {unit:08X}h", of_gear), gear, 0.0)
    if feed is not None:
        return Scale(feed[0] / one / gear, _join(feed[1], of_gear), gear, 1 / one)
    if encoder is not None and not isclose(gear, 1.0):
        raise DeviceUnusable(f"its scale is unknown: it has {of_gear} and {encoder[1]}, but no feed (6092h)")
    return Scale(encoder[0] / one if encoder else None, _join(encoder[1] if encoder else ""), gear, 1 / one)


def read_optional(net: Net, node: int, entry: DictionaryEntry) -> Answer[int | None]:
    """Reads an object that a drive may lack: then None.

    Raises:
        Unfit: the drive has it, and refuses to be read.
    """
    try:
        return (yield from net.read(node, entry))
    except DriveRefused as refused:
        if refused.code in table.NO_SUCH_OBJECT:
            return None
        raise DeviceUnusable(f"it refuses to be read: {refused}") from None


def _ratio(net: Net, node: int, entries: tuple[DictionaryEntry, DictionaryEntry]) -> Answer[tuple[float, str] | None]:
    above = yield from read_optional(net, node, entries[0])
    if above is None:
        return None
    below = (yield from read_optional(net, node, entries[1])) or 0
    source = f"{entries[0].index:04X}h = {above}/{below}"
    if not above or not below:
        raise DeviceUnusable(f"its scale is impossible: {source}; set this object of the drive to what is true")
    return above / below, source


def _unit_in_rad(axis: DriveAxis, scale: Scale, entry: DictionaryEntry, unit: int) -> float:
    """Returns a unit of speed or acceleration in rad/s or rad/s^2 of the joint; raises ``DeviceUnusable``."""
    power, counted, first, second = unit.to_bytes(4, "big")
    is_speed = entry is table.VELOCITY_UNIT
    if (counted, first, second) == (_RPM, _SECOND, 0) and not is_speed:
        counted, first, second = _TURN, _MINUTE, _SECOND
    seconds = (_PER_SPEED if is_speed else _PER_ACCELERATION).get((first, second))
    if counted == _INCREMENT:
        rad = axis.resolution.rad * scale.counts_per_increment
    else:
        rad = _ANGLES.get(counted, 0.0) * scale.gear / axis.joint.gear
    if not rad or seconds is None:
        raise _unusable(entry, unit, "rad/s" if is_speed else "rad/s^2")
    return rad * 10.0 ** _signed(power) / seconds


def _unusable(entry: DictionaryEntry, unit: int, into: str) -> DeviceUnusable:
    power, *codes = unit.to_bytes(4, "big")
    words = [_NAMES.get(code, f"unit {code:02X}h") for code in codes]
    name = "/".join(filter(None, words)) or "no unit"
    factor = f"10^{_signed(power)} " if power else ""
    return DeviceUnusable(
        f"its unit {factor}{name} ({entry} = {unit:08X}h) cannot be converted to {into}; set another one"
    )


def _signed(byte: int) -> int:
    return byte - 256 if byte > 127 else byte


def _join(*parts: str) -> str:
    return ", ".join(filter(None, parts))
