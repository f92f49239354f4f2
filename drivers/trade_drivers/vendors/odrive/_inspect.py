"""Checks of ODrives before anything is commanded: the robot file, and the devices."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from trade.errors import ConfigurationError
from trade_drivers.bus.can import Frame, frame_bits
from trade_drivers.joints import Steps, Unfit, check_joints, check_rate
from trade_drivers.joints.can import Another, check_zero_known
from trade_drivers.joints.can._cycle import asked
from trade_drivers.vendors.odrive import _frames as frames
from trade_drivers.vendors.odrive._axis import OdriveAxis
from trade_drivers.vendors.odrive._frames import Command, Control, Input, frame_id

if TYPE_CHECKING:
    from trade_drivers.vendors.odrive._cycle import OdriveExchange
    from trade_robotfile import CanBus

_FIRMWARE: Final = (0, 6)
_LONGEST_S: Final = 0.5
_BEATS_HZ: Final = 10
"""Heartbeats per second by default."""
_STREAM_HZ: Final = 100
"""Unrequested estimates per second by default."""


def check_bus(bus: "CanBus", axes: Sequence[OdriveAxis], where: str) -> None:
    """Checks the robot file: node numbers, keys, speeds, and whether a cycle is long enough for its frames.

    Raises:
        ConfigurationError: a check failed; names the key and the right value.
    """
    check_joints(axes, where, _check_joint)
    key = f"{where}: bus.{bus.name}"
    if bus.leave != "relax":
        problem = 'an ODrive lets go when its watchdog is not fed; write leave = "relax", and brake what would fall'
        raise ConfigurationError(where=f"{key}.leave", problem=problem)
    if bus.watchdog_s > _LONGEST_S:
        problem = f"{bus.watchdog_s:g} is above {_LONGEST_S:g}: enable() waits once for it, to see that it works"
        raise ConfigurationError(where=f"{key}.watchdog_s", problem=problem)
    check_rate(bus, where, 4)
    spoken = len(axes) * (_BEATS_HZ + _STREAM_HZ) * frame_bits(8)
    cycle = len(axes) * (2 * frame_bits(0) + 3 * frame_bits(8))
    if cycle * bus.rate_hz > bus.bitrate - spoken:
        most = max(0, bus.bitrate - spoken) / cycle
        problem = f"{len(axes)} axes at {bus.bitrate} bit/s: at most {most:.0f} Hz"
        raise ConfigurationError(where=f"{key}.rate_hz", problem=problem)


def _check_joint(axis: OdriveAxis) -> None:
    joint = axis.joint
    if not 0 <= joint.id < frames.NODES:
        raise Unfit(f"{joint.id} is no node; 0 to 62 are", ".id")
    if joint.counts_per_rev is not None:
        raise Unfit("an ODrive reports turns, not counts; leave this key out", ".counts_per_rev")
    if joint.homing_counts:
        raise Unfit("is for servos; leave this key out", ".homing_counts")
    if joint.serial_number is not None:
        raise Unfit("an ODrive reports no serial number here; leave this key out", ".serial_number")
    check_zero_known(axis)


def look_over(bus: "OdriveExchange", axis: OdriveAxis, *, first: bool) -> Steps:
    """Checks the identity of an axis and that it can be measured. Stops an axis that moves.

    An axis with torque before the driver is attached has no active watchdog, as no driver fed it.

    Raises:
        Unfit: the axis cannot be used.
        NoAnswer: the axis does not answer.
    """
    axis.version, since_ns = None, bus.clock()
    yield from asked(bus, axis, [_question(axis, Command.VERSION)], lambda: axis.version is not None)
    _check_version(axis)
    yield from asked(bus, axis, [_question(axis, Command.ERRORS)], lambda: axis.health_ns > since_ns)
    if axis.state_now is None or axis.beat_ns <= since_ns:
        yield from asked(bus, axis, [_question(axis, Command.ERRORS)], lambda: axis.beat_ns > since_ns)
    if first and axis.torque:
        bus.tell(axis, Command.SET_MODE, frames.set_mode(Control.VELOCITY, Input.VELOCITY_RAMP))
        bus.tell(axis, Command.SET_VELOCITY, frames.set_velocity(0.0))
        raise Unfit(
            f"node {axis.id} is under torque although its watchdog was not fed: set axis0.config.enable_watchdog; "
            "it was stopped, and is left under torque"
        )


def _question(axis: OdriveAxis, command: Command) -> Frame:
    return Frame(frame_id(axis.id, command), b"")


def _check_version(axis: OdriveAxis) -> None:
    version = axis.version
    if version is None:
        return
    if version.line != axis.model.line:
        raise Unfit(f"is {axis.joint.model!r}, but node {axis.id} is of product line {version.line}", ".model")
    firmware = ".".join(map(str, version.firmware))
    if version.firmware[:2] != _FIRMWARE:
        raise Unfit(f"the firmware of node {axis.id} is {firmware}; this driver speaks CANSimple of 0.6")
    if axis.joint.firmware is not None and axis.joint.firmware != firmware:
        raise Another("firmware", axis.joint.firmware, firmware)
    if axis.identity not in {None, version}:
        raise Unfit(f"another ODrive answers as node {axis.id}: {version}, not {axis.identity}")
    axis.identity = version
