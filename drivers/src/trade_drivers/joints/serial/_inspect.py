"""Looking a bus of servos over before anything may be commanded: what the file tells, and who is there."""

from collections.abc import Callable, Sequence
from math import tau
from typing import TYPE_CHECKING, Any, Final, TypeVar

from trade.errors import ConfigurationError, WrongDevice
from trade_drivers.joints.serial._answers import BadAnswer, NoAnswer, Refused
from trade_drivers.joints.serial._axis import ServoAxis

if TYPE_CHECKING:
    from trade_drivers.joints.serial._wire import ServoWire
    from trade_drivers.robotfile import SerialBus

__all__ = ["again", "check_firmware", "check_model", "check_ranges", "check_rate", "first_ping"]

_ATTEMPTS: Final = 3
_BRAKING_S: Final = 1.5

_Result = TypeVar("_Result")


def check_ranges(axis: ServoAxis[Any], where: str) -> None:
    """Whether a joint's range is one of its device, and its speed and acceleration can be set and brake it in time.

    Raises:
        ConfigurationError: names the key and what would be right.
    """
    joint, grain = axis.joint, axis.grain
    _check_turn(axis, where)
    for key, value, least in (
        ("max_speed_rad_s", joint.max_speed_rad_s, grain.rad_s),
        ("max_accel_rad_s2", joint.max_accel_rad_s2, grain.rad_s2),
    ):
        if value < least:
            problem = f"{value:.3g} is below {least:.3g}, the least an {joint.model} can be set to"
            raise ConfigurationError(where=f'{where}: joint."{joint.name}".{key}', problem=problem)
    braking_s = joint.max_speed_rad_s / joint.max_accel_rad_s2
    if braking_s > _BRAKING_S:
        problem = f"a stop from max_speed_rad_s takes {braking_s:.2g} s with it; it must take {_BRAKING_S} s at most"
        raise ConfigurationError(where=f'{where}: joint."{joint.name}".max_accel_rad_s2', problem=problem)


def _check_turn(axis: ServoAxis[Any], where: str) -> None:
    """In position control a servo has one turn."""
    joint, last = axis.joint, int(2 * axis.grain.centre) - 1
    if axis.low >= 0 and axis.high <= last:
        return
    low, high = sorted((axis.scale.angle_rad(0), axis.scale.angle_rad(last)))
    key, value = ("min_rad", joint.min_rad) if joint.min_rad < low else ("max_rad", joint.max_rad)
    degrees = "; degrees? radians are meant" if max(abs(joint.min_rad), abs(joint.max_rad)) > tau else ""
    problem = f"{value:.6g} is outside of what an {joint.model} can: {low:.6g} to {high:.6g} rad{degrees}"
    raise ConfigurationError(where=f'{where}: joint."{joint.name}".{key}', problem=problem)


def check_rate(bus: "SerialBus", count: int, cycle_bytes: int, where: str) -> None:
    """Whether a cycle comes often enough, and its bytes fit into it.

    Raises:
        ConfigurationError: names the key and what would be right.
    """
    key = f"{where}: bus.{bus.name}.rate_hz"
    least_hz = 3 / min(bus.watchdog_s, bus.stale_after_s)
    if bus.rate_hz < least_hz:
        problem = f"{bus.rate_hz:g} is too slow for watchdog_s and stale_after_s; at least {least_hz:.3g}"
        raise ConfigurationError(where=key, problem=problem)
    cycle_s = cycle_bytes * 10 / bus.baud
    if cycle_s * bus.rate_hz > 1:
        problem = f"{count} joints at {bus.baud} baud need {cycle_s * 1e3:.1f} ms a cycle: at most {1 / cycle_s:.0f} Hz"
        raise ConfigurationError(where=key, problem=problem)


def first_ping(wire: "ServoWire", bus: "SerialBus", axis: ServoAxis[Any], key: str, registers: Sequence[int]) -> int:
    """The model number of a joint's device, which is alone under its id.

    Args:
        wire: the line.
        bus: its record.
        axis: the joint.
        key: of the robot file, for messages.
        registers: where a device of this vendor keeps its id and its baud rate.

    Raises:
        ConfigurationError: it is absent, or not alone.
    """
    problem = (
        f"no device answers to id {axis.id} on bus {bus.name!r} ({wire.path}, {bus.baud} baud); check its power and "
        f"cable, its id (register {registers[0]}) and its baud rate (register {registers[1]})"
    )
    twice = (
        f"what answers to id {axis.id} is garbled or answers twice: two devices may share this id, or there is noise"
    )
    for _ in range(_ATTEMPTS):
        try:
            number = wire.ping(axis.id)
        except BadAnswer:
            problem = twice
        except NoAnswer:
            pass
        else:
            if not wire.answers_twice():
                return number
            problem = twice
    raise ConfigurationError(where=key, problem=problem)


def again(wire: "ServoWire", axis: ServoAxis[Any], act: Callable[[], _Result]) -> _Result:
    """An exchange, tried three times.

    Raises:
        ConfigurationError: it was refused.
        NoAnswer: nothing came.
    """
    for _ in range(_ATTEMPTS - 1):
        try:
            return act()
        except Refused as refused:
            raise ConfigurationError(where=axis.name, problem=f"it refuses to be read: {refused}") from None
        except NoAnswer:
            wire.ping(axis.id)
    return act()


def check_model(axis: ServoAxis[Any], number: int, name: str, key: str) -> None:
    """Raises ``WrongDevice`` for a device of another model than the robot file's."""
    if number != axis.model_number:
        problem = f"is {axis.joint.model!r}, but id {axis.id} is {name} (model number {number})"
        raise WrongDevice(where=key, key="model", expected=axis.joint.model, found=name, problem=problem)


def check_firmware(axis: ServoAxis[Any], firmware: str, key: str) -> None:
    """Raises ``WrongDevice`` for a device with another firmware than the robot file names, if it names one."""
    expected = axis.joint.firmware
    if expected is not None and firmware != expected:
        raise WrongDevice(where=key, key="firmware", expected=expected, found=firmware)
