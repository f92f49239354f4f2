"""Checks of Damiao motors before anything is commanded: the robot file, and the devices."""

from collections.abc import Sequence
from math import isclose
from typing import TYPE_CHECKING, Final

from trade.errors import ConfigurationError
from trade_drivers.bus.can import Frame, frame_bits
from trade_drivers.joints import Steps, Unfit, check_joints, check_rate
from trade_drivers.joints.can import Another, check_zero_known
from trade_drivers.joints.can._cycle import asked
from trade_drivers.vendors.damiao import _frames as frames
from trade_drivers.vendors.damiao._axis import DamiaoAxis
from trade_drivers.vendors.damiao._frames import Register

if TYPE_CHECKING:
    from trade_drivers.vendors.damiao._cycle import DamiaoExchange
    from trade_robotfile import CanBus

_WITHIN: Final = 0.98
"""The share of a motor's position range that a joint may use, as positions at its two ends look alike."""


def check_bus(bus: "CanBus", axes: Sequence[DamiaoAxis], where: str) -> None:
    """Checks the robot file: identifiers, keys, ranges, and whether a cycle is long enough for its frames.

    Raises:
        ConfigurationError: a check failed; names the key and the right value.
    """
    check_joints(axes, where, _check_joint)
    check_rate(bus, where, 4)
    cycle = len(axes) * 2 * frame_bits(8)
    if cycle * bus.rate_hz > bus.bitrate:
        problem = f"{len(axes)} motors at {bus.bitrate} bit/s: at most {bus.bitrate / cycle:.0f} Hz"
        raise ConfigurationError(where=f"{where}: bus.{bus.name}.rate_hz", problem=problem)


def _check_joint(axis: DamiaoAxis) -> None:
    joint, ranges = axis.joint, axis.ranges
    if not 1 <= joint.id < frames.MASTER:
        raise Unfit(f"{joint.id} is not valid; use 1 to 15 (the motor answers as its id plus 16)", ".id")
    if joint.counts_per_rev is not None:
        raise Unfit("a Damiao motor reports radians, not counts; leave this key out", ".counts_per_rev")
    if joint.homing_counts:
        raise Unfit("is for servos; leave this key out", ".homing_counts")
    if joint.max_speed_rad_s * joint.gear > ranges.velocity_rad_s:
        most = ranges.velocity_rad_s / joint.gear
        raise Unfit(
            f"{joint.max_speed_rad_s:.4g} is above {most:.4g}, the most a {joint.model} reports", ".max_speed_rad_s"
        )
    for key, value in ((".min_rad", joint.min_rad), (".max_rad", joint.max_rad)):
        if abs(axis.scale.counts(value)) * axis.resolution.rad * joint.gear > _WITHIN * ranges.position_rad:
            raise Unfit(f"{value:.4g} is farther from its zero than a {joint.model} can report", key)
    if joint.serial_number is not None:
        raise Unfit("a Damiao motor reports no serial number here; leave this key out", ".serial_number")
    check_zero_known(axis)


def look_over(bus: "DamiaoExchange", axis: DamiaoAxis) -> Steps:
    """Checks the identity and ranges of a motor, and arms its watchdog. Enables and moves nothing.

    Raises:
        Unfit: the motor cannot be used.
        NoAnswer: the motor does not answer.
    """
    yield from check_ranges(bus, axis)
    yield from register(bus, axis, Register.SOFTWARE)
    if axis.software not in {None, axis.answer}:
        raise Unfit(f"another motor answers as {axis.id}: its software is {axis.answer}, not {axis.software}")
    axis.software = int(axis.answer or 0)
    if axis.joint.firmware is not None and axis.joint.firmware != str(axis.software):
        raise Another("firmware", axis.joint.firmware, str(axis.software))
    yield from set_register(bus, axis, Register.TIMEOUT, bus.timeout)
    if axis.answer != bus.timeout:
        raise Unfit(f"it does not keep its time-out (register 9): {axis.answer}, not {bus.timeout}")
    axis.heard_ns = 0
    yield from asked(bus, axis, [bus.refresh(axis)], lambda: axis.heard_ns > 0)


def check_ranges(bus: "DamiaoExchange", axis: DamiaoAxis) -> Steps:
    """Compares the registers that scale positions, speeds and torques with those of the model.

    Raises:
        Unfit, NoAnswer: as for ``look_over``.
    """
    for number, meant in zip(
        (Register.POSITION_MAX, Register.VELOCITY_MAX, Register.TORQUE_MAX), axis.ranges, strict=True
    ):
        yield from register(bus, axis, number)
        if axis.answer is None or not isclose(axis.answer, meant, rel_tol=1e-3):
            name = number.name.replace("_MAX", "").lower()
            problem = (
                f"the {name} of a {axis.joint.model} goes to {meant:g}, but motor {axis.id} is set to {axis.answer:g}"
            )
            raise Unfit(f"{problem} (register {number:d})", ".model")


def register(bus: "DamiaoExchange", axis: DamiaoAxis, number: Register) -> Steps:
    """Requests a register; ``answer`` is then its value."""
    axis.answer, axis.asks = None, number
    question = Frame(frames.BROADCAST, frames.read(axis.id, number))
    yield from asked(bus, axis, [question], lambda: axis.asks is None)


def set_register(bus: "DamiaoExchange", axis: DamiaoAxis, number: Register, value: int) -> Steps:
    """Writes a register and reads it back."""
    axis.answer, axis.asks = None, number
    order = Frame(frames.BROADCAST, frames.write(axis.id, number, value))
    yield from asked(bus, axis, [order], lambda: axis.asks is None)
    yield from register(bus, axis, number)
