"""A calibration file of LeRobot as values of a robot file: homing offsets and ranges of servos, in counts."""

from collections.abc import Mapping, Sequence
from math import ceil, floor, tau
from pathlib import Path
from typing import Annotated, Final

import msgspec
from msgspec import Meta, Struct

from trade.errors import ConfigurationError
from trade.text_files import read_text
from trade_drivers import Joint, Robot, SerialBus

_DRIVERS: Final = {"dynamixel": 1_044_479, "feetech": 2047}
"""The drivers whose servos LeRobot calibrates, and the largest homing offset of these, in counts."""
_TURN: Final = 4096
_CENTRE: Final = 2048
_LAST: Final = _TURN - 1
_DIGITS: Final = 1e4


class Calibrated(Struct, frozen=True):
    """The calibration of one motor, as LeRobot writes it."""

    id: Annotated[int, Meta(ge=0, le=252)]
    homing_offset: int
    range_min: int
    range_max: int
    drive_mode: int = 0
    """1: LeRobot counts it in the opposite direction."""


def read_calibration(path: Path) -> dict[str, Calibrated]:
    """Returns the motors of a calibration file, by LeRobot's names.

    Raises:
        ConfigurationError: the file cannot be read, or is none of LeRobot's calibrations.
    """
    try:
        return msgspec.json.decode(read_text(path), type=dict[str, Calibrated])
    except (OSError, UnicodeDecodeError) as bad:
        why = bad.strerror if isinstance(bad, OSError) else bad.reason
        raise ConfigurationError(where=str(path), problem=f"cannot be read: {why}") from None
    except msgspec.MsgspecError as bad:
        form = "one table a motor with id, homing_offset, range_min and range_max"
        raise ConfigurationError(where=str(path), problem=f"is no calibration of LeRobot, {form}: {bad}") from None


def imported(
    robot: Robot, motors: Mapping[str, Calibrated], where: str, joint: str | None = None, bus: str | None = None
) -> tuple[dict[str, dict[str, float]], list[str]]:
    """Returns the values of each joint's keys, and remarks for the user.

    Args:
        robot: the robot file.
        motors: from `read_calibration`.
        where: the calibration file, for messages.
        joint: the only joint to import; by default all.
        bus: the bus of the arm; only needed if several buses have its ids.

    Raises:
        ConfigurationError: the calibration is that of another arm, or no such servo can have it.
    """
    joints = _joints_of(robot, motors, where, bus)
    values: dict[str, dict[str, float]] = {}
    remarks: list[str] = []
    for name, motor in motors.items():
        one = joints[motor.id]
        if joint in {None, one.name}:
            driver = next(line.driver for line in robot.buses if line.name == one.bus)
            _check(motor, f"{where}: {name}", _DRIVERS[driver])
            values[one.name] = _values(one, motor)
            remarks += _remarks(one, motor, reversed_inside=driver == "dynamixel")
    if not values:
        raise ConfigurationError(where=where, problem=f"has no motor with the id of joint {joint}")
    return values, remarks


def _joints_of(robot: Robot, motors: Mapping[str, Calibrated], where: str, bus: str | None) -> dict[int, Joint]:
    """Returns the joints by id, of the only bus that has all ids of the calibration under no contrary names."""
    ids = sorted(motor.id for motor in motors.values())
    if len(set(ids)) < len(ids):
        raise ConfigurationError(where=where, problem=f"has two motors of one id; it has ids {_listed(ids)}")
    lines = [line for line in robot.buses if line.driver in _DRIVERS and isinstance(line, SerialBus)]
    by_bus = {
        line.name: {one.id: one for one in robot.joints_on(line.name)} for line in lines if bus in {None, line.name}
    }
    fitting = [name for name, there in by_bus.items() if there.keys() >= set(ids)]
    if not fitting:
        there = "; ".join(f"bus {name} has {_listed(sorted(there))}" for name, there in by_bus.items())
        servos = there or f"there is no bus of {' or '.join(_DRIVERS)} servos" + (f" named {bus}" if bus else "")
        problem = f"is the calibration of another arm than {robot.where}: it has ids {_listed(ids)}, but {servos}"
        raise ConfigurationError(where=where, problem=problem)
    if len(fitting) > 1:
        problem = f"fits the buses {' and '.join(fitting)}; choose one with --bus"
        raise ConfigurationError(where=where, problem=problem)
    joints = by_bus[fitting[0]]
    for name, motor in motors.items():
        other = next((one for one in joints.values() if one.name.rpartition(".")[2] == name), None)
        if other is not None and other.id != motor.id:
            problem = f"has {name} as id {motor.id}, but joint {other.name} has id {other.id}: that is another arm"
            raise ConfigurationError(where=where, problem=problem)
    return joints


def _check(motor: Calibrated, where: str, most: int) -> None:
    """Checks that a servo can have the calibration, and that it is whole."""
    if abs(motor.homing_offset) > most:
        problem = f"homing_offset {motor.homing_offset} is more than a servo can have, -{most} to {most}"
        raise ConfigurationError(where=where, problem=problem)
    if not 0 <= motor.range_min < motor.range_max <= _LAST:
        problem = (
            f"range {motor.range_min} to {motor.range_max} is none within 0 to {_LAST}: the joint passed the end of "
            "its encoder. Calibrate it again from another middle"
        )
        raise ConfigurationError(where=where, problem=problem)


def _values(joint: Joint, motor: Calibrated) -> dict[str, float]:
    low, high = sorted(_angle_rad(joint, count) for count in (motor.range_min, motor.range_max))
    return {
        "homing_counts": motor.homing_offset,
        "offset_rad": 0.0,
        "min_rad": ceil(low * _DIGITS) / _DIGITS,
        "max_rad": floor(high * _DIGITS) / _DIGITS,
    }


def _angle_rad(joint: Joint, count: float) -> float:
    return (-1 if joint.reversed else 1) * (count - _CENTRE) * tau / _TURN


def _remarks(joint: Joint, motor: Calibrated, *, reversed_inside: bool) -> list[str]:
    middle_rad = _angle_rad(joint, (motor.range_min + motor.range_max) / 2)
    pose = f"{joint.name}: 0 rad is count {_CENTRE}, the pose in which LeRobot took its homing offset"
    notes = [f"{pose}; its degrees count from the middle of the range, at {middle_rad:.4f} rad"]
    if (motor.range_min, motor.range_max) == (0, _LAST):
        notes.append(
            f"{joint.name}: its range is a whole turn. If it has mechanical ends, it passed the end of its encoder "
            f"while it was recorded: measure its range with `trade calibrate`"
        )
    if motor.drive_mode and not reversed_inside and not joint.reversed:
        notes.append(f"{joint.name}: LeRobot counts it in the opposite direction; `reversed = true` does the same here")
    return notes


def _listed(numbers: Sequence[int]) -> str:
    return ", ".join(map(str, numbers)) or "none"
