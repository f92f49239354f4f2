"""Checks of a servo bus before anything may be commanded: the robot file, and the devices."""

from collections.abc import Callable, Sequence
from math import tau
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from trade.errors import ConfigurationError, DeviceAbsent, WrongDevice
from trade_drivers.bus._attempts import ATTEMPTS, attempts
from trade_drivers.bus._jobs import BadAnswer, NoAnswer, RequestRefused
from trade_drivers.joints import DeviceUnusable, check_least, check_rate
from trade_drivers.joints.serial._axis import ServoAxis
from trade_robotfile import SerialBus

if TYPE_CHECKING:
    from trade_drivers.joints.serial._wire import ServoWire

_Result = TypeVar("_Result")


class PersistentRegisters(NamedTuple):
    """The layout of the persistent registers of one vendor's servos."""

    registers: tuple[int, int]
    """The registers of the id and the baud rate."""
    name_of: Callable[[int, str], str]
    """Returns the name of a model number, or a default."""
    firmware: Callable[[bytes], str]


def check_ranges(axis: ServoAxis[Any]) -> None:
    """Raises ``DeviceUnusable`` for a range that exceeds the device's, or a limit that cannot be set."""
    _check_turn(axis)
    check_least(axis, f"the least setting of an {axis.joint.model}")


def _check_turn(axis: ServoAxis[Any]) -> None:
    """Checks that the range fits into one turn, as position control requires."""
    joint, last = axis.joint, int(2 * axis.resolution.centre) - 1
    if axis.low >= 0 and axis.high <= last:
        return
    low, high = sorted((axis.scale.angle_rad(0), axis.scale.angle_rad(last)))
    key, value = (".min_rad", joint.min_rad) if joint.min_rad < low else (".max_rad", joint.max_rad)
    degrees = "; degrees? radians are meant" if max(abs(joint.min_rad), abs(joint.max_rad)) > tau else ""
    problem = f"{value:.6g} is outside the range of an {joint.model}: {low:.6g} to {high:.6g} rad{degrees}"
    raise DeviceUnusable(problem, key)


def check_cycle(bus: SerialBus, count: int, cycle_bytes: int, where: str) -> None:
    """Checks that cycles are frequent enough and long enough for their bytes.

    Raises:
        ConfigurationError: they are not; names the key and the right value.
    """
    check_rate(bus, where, 3)
    cycle_s = cycle_bytes * 10 / bus.baud
    if cycle_s * bus.rate_hz > 1:
        problem = f"{count} joints at {bus.baud} baud need {cycle_s * 1e3:.1f} ms a cycle: at most {1 / cycle_s:.0f} Hz"
        raise ConfigurationError(where=f"{where}: bus.{bus.name}.rate_hz", problem=problem)


def first_ping(
    wire: "ServoWire",
    bus: SerialBus,
    axis: ServoAxis[Any],
    clock_ns: Callable[[], int],
    key: str,
    registers: Sequence[int],
) -> int:
    """Returns the model number of a joint's device.

    Raises:
        DeviceAbsent: no device answers.
        ConfigurationError: two share the id, or there is noise.
    """
    problem = (
        f"no device answers to id {axis.id} on bus {bus.name!r} ({wire.path}, {bus.baud} baud); check its power and "
        f"cable, its id (register {registers[0]}) and its baud rate (register {registers[1]})"
    )
    absent = True
    twice = f"the answer of id {axis.id} is garbled or arrives twice: two devices may share this id, or there is noise"
    garbled = 0
    for _ in attempts(clock_ns, int(bus.stale_after_s * 1e9)):
        try:
            number = wire.ping(axis.id)
        except BadAnswer:
            garbled += 1
        except NoAnswer:
            continue
        else:
            if not wire.answers_twice():
                return number
            garbled += 1
        problem, absent = twice, False
        if garbled == ATTEMPTS:  # with more of them, the answers of two devices might once look like one
            break
    if company := wire.intruder():
        raise ConfigurationError(where=key, problem=company)
    raise (DeviceAbsent if absent else ConfigurationError)(where=key, problem=problem)


def again(
    wire: "ServoWire",
    bus: SerialBus,
    axis: ServoAxis[Any],
    clock_ns: Callable[[], int],
    act: Callable[[], _Result],
) -> _Result:
    """Runs an exchange within the retry budget; a ping before each retry discards late answers.

    Raises:
        ConfigurationError: the device refused.
        NoAnswer: no answer arrived.
    """
    silent = NoAnswer(axis.id, 0.0)
    for attempt in attempts(clock_ns, int(bus.stale_after_s * 1e9)):
        try:
            if attempt:
                wire.ping(axis.id)
            return act()
        except RequestRefused as refused:
            raise ConfigurationError(where=axis.name, problem=f"it refuses to be read: {refused}") from None
        except NoAnswer as missed:
            silent = missed
    raise silent


def check_model(axis: ServoAxis[Any], number: int, name: str, key: str) -> None:
    """Raises ``WrongDevice`` for a device of another model than the robot file's."""
    if number != axis.model_number:
        problem = f"is {axis.joint.model!r}, but id {axis.id} is {name} (model number {number})"
        raise WrongDevice(where=key, key="model", expected=axis.joint.model, found=name, problem=problem)


def check_firmware(axis: ServoAxis[Any], firmware: str, key: str) -> None:
    """Raises ``WrongDevice`` for a device with another firmware than the robot file's, if that has one."""
    expected = axis.joint.firmware
    if expected is not None and firmware != expected:
        raise WrongDevice(where=key, key="firmware", expected=expected, found=firmware)


def check_homing(axis: ServoAxis[Any], settings: bytes, key: str) -> None:
    """Raises ``WrongDevice`` for a servo with another zero; ``settings`` are its registers from address 0."""
    if problem := axis.zero_moved(settings):
        expected, found = str(axis.joint.homing_counts), str(axis.homing.decode(settings))
        raise WrongDevice(where=key, key="homing_counts", expected=expected, found=found, problem=problem)


def first_look(
    wire: "ServoWire",
    bus: SerialBus,
    axis: ServoAxis[Any],
    kept: PersistentRegisters,
    clock_ns: Callable[[], int],
    key: str,
) -> bytes:
    """Checks that a joint's device is that of the robot file, and takes its first measurements.

    Returns:
        The bytes of its persistent registers, from address 0.

    Raises:
        DeviceAbsent: no device answers.
        ConfigurationError: the device is another model, or shares its id.
        NoAnswer: the device answers a ping, but no read.
    """
    number = first_ping(wire, bus, axis, clock_ns, key, kept.registers)
    check_model(axis, number, kept.name_of(number, "a model this driver does not know"), key)
    asked_ns = clock_ns()
    settings = again(wire, bus, axis, clock_ns, lambda: wire.read(axis.id, *axis.settings).data)
    health = again(wire, bus, axis, clock_ns, lambda: wire.read(axis.id, *axis.slow).data)
    sample = again(wire, bus, axis, clock_ns, lambda: wire.read(axis.id, *axis.cyclic).data)
    check_firmware(axis, kept.firmware(settings), key)
    check_homing(axis, settings, key)
    axis.take_health(health, asked_ns)
    axis.take_sample(sample, asked_ns, clock_ns())
    return settings


def check_own_range(axis: ServoAxis[Any], settings: bytes, key: str) -> None:
    """Raises ``ConfigurationError`` for a joint whose range exceeds the one set in its device."""
    least, most = axis.ends
    low, high = axis.own_range = least.decode(settings), most.decode(settings)
    if axis.low < low or axis.high > high:
        joint, ends = axis.joint, sorted((axis.scale.angle_rad(low), axis.scale.angle_rad(high)))
        raise ConfigurationError(
            where=key,
            problem=f"min_rad {joint.min_rad:.6g} to max_rad {joint.max_rad:.6g} is more than the device's own range "
            f"(registers {least.address} and {most.address}), {ends[0]:.6g} to {ends[1]:.6g} rad; "
            "narrow the former or widen the latter",
        )
