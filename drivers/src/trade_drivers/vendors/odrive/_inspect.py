"""Looking ODrives over before anything is commanded: what the file asks of them, and who answers."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from trade.errors import ConfigurationError
from trade_drivers.bus.can import Frame, frame_bits
from trade_drivers.joints import Steps, Unfit, check_joints, check_rate
from trade_drivers.joints.can import Another
from trade_drivers.joints.can._cycle import asked
from trade_drivers.vendors.odrive import _frames as frames
from trade_drivers.vendors.odrive._axis import OdriveAxis
from trade_drivers.vendors.odrive._frames import Command, Control, Input, frame_id

if TYPE_CHECKING:
    from trade_drivers.robotfile import CanBus
    from trade_drivers.vendors.odrive._cycle import OdriveExchange

__all__ = ["check_bus", "look_over"]

_FIRMWARE: Final = (0, 6)
_LONGEST_S: Final = 0.5
_BEATS_HZ: Final = 10
"""Heartbeats as an ODrive sends them if nobody has changed that."""
_STREAM_HZ: Final = 100
"""Likewise estimates that nobody asked for."""


def check_bus(bus: "CanBus", axes: Sequence[OdriveAxis], where: str) -> None:
    """What the file alone can tell: numbers of nodes, keys, speeds, and whether the frames of a cycle fit into it.

    Raises:
        ConfigurationError: names the key and what would be right.
    """
    check_joints(axes, where, _check_joint)
    key = f"{where}: bus.{bus.name}"
    if bus.leave != "relax":
        problem = 'an ODrive lets go when nobody feeds its watchdog; write leave = "relax", and brake what would fall'
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
        raise Unfit("an ODrive tells turns, not counts; leave this key out", ".counts_per_rev")
    if joint.homing_counts:
        raise Unfit("is for servos; leave this key out", ".homing_counts")
    if joint.serial_number is not None:
        raise Unfit("an ODrive tells no serial number here; leave this key out", ".serial_number")


def look_over(bus: "OdriveExchange", axis: OdriveAxis, *, first: bool) -> Steps:
    """Check who an axis is and that it can be measured.

    Found under torque by somebody who attaches, its watchdog is off: nobody fed it. Found moving, it is stopped.

    Raises:
        Unfit: it cannot be used.
        NoAnswer: it does not answer.
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
            f"node {axis.id} is under torque although nobody has fed its watchdog: set axis0.config.enable_watchdog; "
            "it was told to stand, and is left so"
        )


def _question(axis: OdriveAxis, command: Command) -> Frame:
    return Frame(frame_id(axis.id, command), b"")


def _check_version(axis: OdriveAxis) -> None:
    version = axis.version
    if version is None:
        return
    if version.line != axis.model.line:
        raise Unfit(f"is {axis.joint.model!r}, but node {axis.id} is of product line {version.line}", ".model")
    told = ".".join(map(str, version.firmware))
    if version.firmware[:2] != _FIRMWARE:
        raise Unfit(f"the firmware of node {axis.id} is {told}; this driver speaks CANSimple of 0.6")
    if axis.joint.firmware is not None and axis.joint.firmware != told:
        raise Another("firmware", axis.joint.firmware, told)
    if axis.identity not in {None, version}:
        raise Unfit(f"another ODrive answers as node {axis.id}: {version}, not {axis.identity}")
    axis.identity = version
