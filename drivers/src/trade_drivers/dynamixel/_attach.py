"""Looking a bus over before anything may be commanded: who is there, and set how. Moves nothing and resets nothing."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final, NoReturn, TypeVar

from trade.errors import ConfigurationError
from trade_drivers.dynamixel import _table as table
from trade_drivers.dynamixel._axis import CYCLIC, SLOW, Health, ServoAxis
from trade_drivers.dynamixel._wire import BadAnswer, NoAnswer, Refused

if TYPE_CHECKING:
    from trade_drivers.dynamixel._sdk import Wire
    from trade_drivers.robotfile import SerialBus

__all__ = ["check_bus", "look_over"]

_ATTEMPTS: Final = 3
_BRAKING_S: Final = 1.5
_EEPROM: Final = (table.MODEL_NUMBER.address, table.MIN_POSITION.end)
_OTHER_THAN_REVERSED: Final = 0xFE
_SHADOWS: Final = 252
_ALL_ANSWER: Final = 2

_Result = TypeVar("_Result")


def check_bus(bus: "SerialBus", axes: Sequence[ServoAxis], where: str) -> None:
    """What the file alone can tell: models, speeds, and whether the bytes of a cycle fit into it.

    Raises:
        ConfigurationError: names the key and what would be right.
    """
    for axis in axes:
        for key, value, least in (
            ("max_speed_rad_s", axis.joint.max_speed_rad_s, table.RAD_S_PER_COUNT),
            ("max_accel_rad_s2", axis.joint.max_accel_rad_s2, table.RAD_S2_PER_COUNT),
        ):
            if value < least:
                problem = f"{value:.3g} is below {least:.3g}, the least an {axis.model.name} can be set to"
                raise ConfigurationError(where=f'{where}: joint."{axis.joint.name}".{key}', problem=problem)
        braking_s = axis.joint.max_speed_rad_s / axis.joint.max_accel_rad_s2
        if braking_s > _BRAKING_S:
            problem = (
                f"a stop from max_speed_rad_s takes {braking_s:.2g} s with it; it must take {_BRAKING_S} s at most"
            )
            raise ConfigurationError(where=f'{where}: joint."{axis.joint.name}".max_accel_rad_s2', problem=problem)
    least_hz = 3 / min(bus.watchdog_s, bus.stale_after_s)
    if bus.rate_hz < least_hz:
        problem = f"{bus.rate_hz:g} is too slow for watchdog_s and stale_after_s; at least {least_hz:.3g}"
        raise ConfigurationError(where=f"{where}: bus.{bus.name}.rate_hz", problem=problem)
    count = len(axes)
    read = 14 + count + (18 + count * 14 if bus.fast_sync else count * (11 + CYCLIC[1]))
    cycle_s = (read + 14 + count * 5) * 10 / bus.baud
    if cycle_s * bus.rate_hz > 1:
        problem = f"{count} joints at {bus.baud} baud need {cycle_s * 1e3:.1f} ms a cycle: at most {1 / cycle_s:.0f} Hz"
        raise ConfigurationError(where=f"{where}: bus.{bus.name}.rate_hz", problem=problem)


def look_over(wire: "Wire", bus: "SerialBus", axis: ServoAxis, clock_ns: Callable[[], int], where: str) -> float:
    """Check one joint's device and take its first measurements.

    Returns:
        Its return delay in seconds, which only costs speed.

    Raises:
        ConfigurationError: it is absent, another model, set wrongly, or not alone under its id.
    """
    key = f'{where}: joint."{axis.joint.name}"'
    _check_model(axis, _ping(wire, bus, axis, key), key)
    silent = "it answers a ping but no read: its status return level (68) is 0 or 1; set it to 2"
    try:
        asked_ns = clock_ns()
        settings = _again(wire, axis, lambda: wire.read(axis.id, *_EEPROM).data)
        health = _again(wire, axis, lambda: wire.read(axis.id, *SLOW).data)
        sample = _again(wire, axis, lambda: wire.read(axis.id, *CYCLIC).data)
    except NoAnswer:
        raise ConfigurationError(where=key, problem=silent) from None
    axis.take_health(Health.decode(health, asked_ns))
    axis.take_sample(sample, asked_ns)
    _check_settings(axis, settings, key)
    return table.RETURN_DELAY.decode(settings) * table.RETURN_DELAY.si_per_count


def _ping(wire: "Wire", bus: "SerialBus", axis: ServoAxis, key: str) -> int:
    problem = (
        f"no device answers to id {axis.id} on bus {bus.name!r} ({wire.path}, {bus.baud} baud); check its power and "
        "cable, its id (register 7) and its baud rate (register 8)"
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
    return _wrong(key, problem)


def _check_model(axis: ServoAxis, number: int, key: str) -> None:
    if number == axis.model.number:
        return
    found = table.BY_MODEL_NUMBER.get(number)
    name = found.name if found else "a model this driver does not know"
    _wrong(f"{key}.model", f"is {axis.model.name!r}, but id {axis.id} is {name} (model number {number})")


def _check_settings(axis: ServoAxis, settings: bytes, key: str) -> None:
    joint, health = axis.joint, axis.health
    mode, drive = table.OPERATING_MODE.decode(settings), table.DRIVE_MODE.decode(settings)
    if health is not None and health.status_level != _ALL_ANSWER:
        _wrong(key, f"its status return level (register 68) is {health.status_level}; set it to 2")
    if mode != table.POSITION_MODE:
        _wrong(key, f"its operating mode (register 11) is {mode}; set it to 3, position control, with torque off")
    if drive & _OTHER_THAN_REVERSED:
        problem = (
            f"its drive mode (register 10) is {drive}; set it to {drive & 1}, with torque off: speeds as velocities"
        )
        _wrong(key, f"{problem}, torque switched on by nothing but us")
    if (shadow := table.SHADOW_ID.decode(settings)) <= _SHADOWS:
        _wrong(key, f"it also obeys what is sent to id {shadow} (register 12); set it to 255, with torque off")
    low, high = table.MIN_POSITION.decode(settings), table.MAX_POSITION.decode(settings)
    if axis.low < low or axis.high > high:
        ends = sorted((axis.scale.angle_rad(low), axis.scale.angle_rad(high)))
        _wrong(
            key,
            f"min_rad {joint.min_rad:.6g} to max_rad {joint.max_rad:.6g} is more than the device's own range "
            f"(registers 52 and 48), {ends[0]:.6g} to {ends[1]:.6g} rad; narrow the one or widen the other",
        )
    fastest = table.VELOCITY_LIMIT.decode(settings)
    if axis.speed_counts > fastest:
        limit = fastest * table.RAD_S_PER_COUNT
        _wrong(
            f"{key}.max_speed_rad_s",
            f"{joint.max_speed_rad_s:.6g} is above the device's own limit {limit:.4g} (register 44)",
        )


def _again(wire: "Wire", axis: ServoAxis, act: Callable[[], _Result]) -> _Result:
    for _ in range(_ATTEMPTS - 1):
        try:
            return act()
        except Refused as refused:
            raise ConfigurationError(where=axis.name, problem=f"it refuses to be read: {refused}") from None
        except NoAnswer:
            wire.ping(axis.id)
    return act()


def _wrong(where: str, problem: str) -> NoReturn:
    raise ConfigurationError(where=where, problem=problem)
