"""The exchange with the ODrives of a bus: its checks, and commands in each cycle and step by step."""

import logging
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Final

from trade.errors import ConfigurationError, TradeError
from trade_drivers.bus._cycle import HALT_NS
from trade_drivers.bus.can import Frame, frame_bits
from trade_drivers.joints import (
    AwaitedJob,
    DeviceUnusable,
    Gate,
    Goal,
    Steps,
    check_joints,
    check_rate,
    next_measurement,
    until,
)
from trade_drivers.joints.can import DifferentMotor, check_keys, check_load
from trade_drivers.joints.can._cycle import MotorExchange
from trade_drivers.vendors.odrive import _frames as frames
from trade_drivers.vendors.odrive._axis import COUNTS_PER_TURN, OdriveAxis
from trade_drivers.vendors.odrive._frames import frame_id
from trade_drivers.vendors.odrive._table import NODES, ORDERS, Command, Control, Errors, Input, State
from trade_robotfile import CanBus

if TYPE_CHECKING:
    from trade_drivers.bus.can import CanPort

_log = logging.getLogger("trade")
_HEALTH: Final = (Command.ERRORS, Command.CURRENTS, Command.TEMPERATURES, Command.SUPPLY)
_BEATS_MISSED_NS: Final = 500_000_000
"""Five heartbeats at an ODrive's default rate."""
_SLACK_NS: Final = 250_000_000
"""The delay allowed for the report that the watchdog expired: a heartbeat, and a busy host."""
_AT_REST: Final = 2
_WAIT_S: Final = 0.001
_FIRMWARE: Final = (0, 6)
_LONGEST_S: Final = 0.5
_BEATS_HZ: Final = 10
"""Heartbeats per second by default."""
_STREAM_HZ: Final = 100
"""Unrequested estimates per second by default."""


def check_bus(bus: CanBus, axes: Sequence[OdriveAxis], where: str) -> None:
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
    unrequested = len(axes) * (_BEATS_HZ + _STREAM_HZ) * frame_bits(8)
    cycle = len(axes) * (2 * frame_bits(0) + 3 * frame_bits(8))
    check_load(bus, where, f"{len(axes)} axes", cycle, unrequested)


def _check_joint(axis: OdriveAxis) -> None:
    if not 0 <= axis.joint.id < NODES:
        raise DeviceUnusable(f"{axis.joint.id} is no node; 0 to 62 are", ".id")
    check_keys(axis, "an ODrive", "turns")


class OdriveExchange(MotorExchange[OdriveAxis]):
    """The exchange with the ODrives of one bus.

    The requests in each cycle feed the watchdogs of the axes.
    """

    axis_type = OdriveAxis
    check_bus = staticmethod(check_bus)

    def __init__(
        self, port: "CanPort", bus: CanBus, axes: Sequence[OdriveAxis], clock: Callable[[], int] | None = None
    ) -> None:
        super().__init__(port, bus, axes, clock)
        self.silent_after_ns = max(_BEATS_MISSED_NS, self.stale_after_ns)
        self.rival = False
        """True if another driver commands these axes."""
        for axis in axes:
            for command, listener in axis.listeners(self.clock).items():
                self.net.hear(frame_id(axis.id, command), listener)
            self._listen_for_rivals(axis)

    def _listen_for_rivals(self, axis: OdriveAxis) -> None:
        """Detects other drivers: their frames feed the watchdogs, which then miss this driver's death."""
        for command in ORDERS:
            self.net.hear(frame_id(axis.id, command), self._hear_rival)
        take = axis.listeners(self.clock)[Command.ESTIMATES]
        self.net.hear(frame_id(axis.id, Command.ESTIMATES), lambda data: take(data) if data else self._hear_rival(data))

    def _hear_rival(self, _: bytes) -> None:
        if not self.rival:
            _log.error("%s: another driver commands the axes of this bus, too", self.port.path)
        self.rival = True

    # --- commands

    def tell(self, axis: OdriveAxis, command: Command, data: bytes) -> None:
        """Sends one frame to an axis; only its heartbeat shows whether it obeys."""
        self.port.send(frame_id(axis.id, command), data)

    def limit(self, axis: OdriveAxis, speed: int, accel: int) -> None:
        """Sets the speed and acceleration of later moves; moves nothing."""
        self.tell(axis, Command.SET_TRAJECTORY_SPEED, frames.set_trajectory_speed(speed / COUNTS_PER_TURN))
        self.tell(axis, Command.SET_TRAJECTORY_ACCEL, frames.set_trajectory_accel(accel / COUNTS_PER_TURN))

    def send_to(self, axis: OdriveAxis, position: int) -> None:
        """Makes the axis move to a position and hold."""
        self.tell(axis, Command.SET_POSITION, frames.set_position(position / COUNTS_PER_TURN))

    def write_goals(self, goals: Mapping[OdriveAxis, Goal], gate: Gate) -> None:
        """Sends the limits, which move nothing; then, after the gate, starts all joints together."""
        for axis, goal in goals.items():
            self.limit(axis, goal.speed, goal.accel)
        self.write_positions({axis: goal.position for axis, goal in goals.items()}, gate)

    def write_positions(self, positions: Mapping[OdriveAxis, int], gate: Gate) -> None:
        commands = [
            Frame(frame_id(axis.id, Command.SET_POSITION), frames.set_position(position / COUNTS_PER_TURN))
            for axis, position in positions.items()
        ]
        gate()
        self.port.send_all(commands)

    def write_holds(self, positions: Mapping[OdriveAxis, int]) -> None:
        """Sends a trajectory to the measured position at full deceleration, only to axes with torque."""
        for axis, position in positions.items():
            if axis.armed and not axis.unfed:
                self.limit(axis, axis.speed_counts, axis.accel_counts)
                self.send_to(axis, position)

    # --- enabling, relaxing and leaving: one exchange after the other

    def enabling(self, job: AwaitedJob[OdriveAxis], axis: OdriveAxis) -> Steps:
        """Switches torque on at the measured position after one test of the watchdog; heartbeats confirm each state.

        An axis that already has torque must be at rest, and keeps holding.
        """
        yield from self.looking(axis)
        if axis.motion is not None and not axis.fault:
            self.end_motion(axis, f"{axis.name} was enabled again")
        if axis.errors:
            yield from self._clear(job, axis)
        if not axis.armed and not axis.proven:
            others = [other for other in job.devices if other is not axis]
            idle = [other for other in others if not (other.proven or other.torque or other.errors or other.silent)]
            yield from self._try_watchdogs(job, [axis, *idle])
            yield from next_measurement(self, axis)
        if axis.torque:
            yield from until(self, axis, lambda: axis.still >= _AT_REST, "it cannot be enabled while it moves", HALT_NS)
        here = axis.fresh(self.clock(), self.stale_after_ns).position
        axis.check_zero()
        job.gate()
        self.limit(axis, axis.speed_counts, axis.accel_counts)
        self.tell(axis, Command.SET_MODE, frames.set_mode(Control.POSITION, Input.TRAJECTORY))
        self.send_to(axis, here)
        if not axis.armed:
            yield from self._arm(job, axis)
        axis.fault, axis.ready = "", True

    def _arm(self, job: AwaitedJob[OdriveAxis], axis: OdriveAxis) -> Steps:
        job.gate()
        self.tell(axis, Command.SET_STATE, frames.set_state(State.CLOSED_LOOP))
        since_ns = self.clock()
        yield from until(self, axis, lambda: axis.armed or _reported_since(axis, since_ns), "it does not answer")
        if not axis.armed:
            raise axis.fault_error(f"it cannot be enabled: {axis.refusal}")

    def _clear(self, job: AwaitedJob[OdriveAxis], axis: OdriveAxis) -> Steps:
        """Clears its errors, without arming it."""
        job.gate()
        self.tell(axis, Command.CLEAR_ERRORS, b"\0")
        since_ns = self.clock()
        stays = f"error: {axis.errors.text}; it cannot be cleared"
        yield from until(self, axis, lambda: axis.health_ns > since_ns and not axis.errors, stays)
        axis.disarmed_by = Errors(0)

    def _try_watchdogs(self, job: AwaitedJob[OdriveAxis], axes: Sequence[OdriveAxis]) -> Steps:
        """Tests the watchdogs, which no reading shows: arms axes without torque, and is silent until they disarm."""
        job.gate()
        for axis in axes:
            axis.unfed = True
        try:
            for axis in axes:
                self.tell(axis, Command.SET_MODE, frames.set_mode(Control.TORQUE, Input.PASSTHROUGH))
                self.tell(axis, Command.SET_TORQUE, frames.set_torque(0.0))
                self.tell(axis, Command.SET_STATE, frames.set_state(State.CLOSED_LOOP))
            give_up_ns = self.clock() + self.watchdog_ns + _SLACK_NS
            for axis in axes:
                yield from self._await_watchdog(job, axis, give_up_ns)
        except TradeError:
            for axis in axes:
                self.tell(axis, Command.SET_STATE, frames.set_state(State.IDLE))
            raise
        finally:
            for axis in axes:
                axis.unfed = False
        for axis in axes:
            yield from self._clear(job, axis)
            axis.proven = True

    def _await_watchdog(self, job: AwaitedJob[OdriveAxis], axis: OdriveAxis, give_up_ns: int) -> Steps:
        while not axis.errors:
            job.gate()
            self.require_answering(axis)
            if axis.beat_ns > give_up_ns:
                if not axis.armed:
                    raise axis.fault_error(f"it cannot be enabled: {axis.refusal}")
                most_s = self.watchdog_ns / 1e9
                raise axis.fault_error(
                    f"its watchdog does not let go within {most_s:g} s; set axis0.config.enable_watchdog and "
                    f"watchdog_timeout = {most_s:g}, or watchdog_s to what it is"
                )
            self.idle(_WAIT_S)
            yield
        if not axis.errors & Errors.WATCHDOG:
            raise axis.fault_error(f"it cannot be enabled: {axis.refusal}")

    def relaxing(self, job: AwaitedJob[OdriveAxis], axis: OdriveAxis) -> Steps:
        """Switches torque off, which also idles the watchdog."""
        axis.ready = False
        if axis.may_hold_torque:
            job.gate()
            self.tell(axis, Command.SET_STATE, frames.set_state(State.IDLE))
        yield from until(self, axis, lambda: not axis.may_hold_torque, "it did not relax: its torque is still on")

    def leaving(self, job: AwaitedJob[OdriveAxis], axis: OdriveAxis, *, relax: bool) -> Steps:  # noqa: ARG002 - it can only relax
        return self.relaxing(job, axis)

    # --- identity and requests

    def verify(self, axis: OdriveAxis) -> Steps:
        """Checks the identity of an axis and that it can be measured. Stops an axis that moves.

        An axis with torque before the driver is attached has no active watchdog, as no driver fed it.

        Raises:
            Unfit: the axis cannot be used.
            NoAnswer: the axis does not answer.
        """
        first = axis.identity is None
        axis.version, since_ns = None, self.clock()
        yield from self.request(axis, [_question(axis, Command.VERSION)], lambda: axis.version is not None)
        _check_version(axis)
        yield from self.request(axis, [_question(axis, Command.ERRORS)], lambda: axis.health_ns > since_ns)
        if axis.state_now is None or axis.beat_ns <= since_ns:
            yield from self.request(axis, [_question(axis, Command.ERRORS)], lambda: axis.beat_ns > since_ns)
        if first and axis.torque:
            self.tell(axis, Command.SET_MODE, frames.set_mode(Control.VELOCITY, Input.VELOCITY_RAMP))
            self.tell(axis, Command.SET_VELOCITY, frames.set_velocity(0.0))
            raise DeviceUnusable(
                f"node {axis.id} is under torque although its watchdog was not fed: set axis0.config.enable_watchdog; "
                "it was stopped, and is left under torque"
            )

    def question(self, axis: OdriveAxis) -> Frame:
        return _question(axis, Command.ESTIMATES)

    def look_after(self, axis: OdriveAxis) -> None:
        """Requests errors, current, temperatures and supply in turn; disarms an axis that does not obey a stop."""
        axis.asked_after = (axis.asked_after + 1) % len(_HEALTH)
        self.tell(axis, _HEALTH[axis.asked_after], b"")
        if axis.halting_since_ns and self.clock() - axis.halting_since_ns > HALT_NS and axis.armed:
            _log.error("%s: a stop was sent, but it is still moving; emergency stop", axis.name)
            self.tell(axis, Command.ESTOP, b"")


def _reported_since(axis: OdriveAxis, since_ns: int) -> bool:
    """Returns whether a heartbeat long enough after the arm command shows that it is not armed."""
    return axis.beat_ns - since_ns > _SLACK_NS // 2


def _question(axis: OdriveAxis, command: Command) -> Frame:
    return Frame(frame_id(axis.id, command), b"")


def _check_version(axis: OdriveAxis) -> None:
    version = axis.version
    if version is None:
        return
    if version.line != axis.model.line:
        raise DeviceUnusable(f"is {axis.joint.model!r}, but node {axis.id} is of product line {version.line}", ".model")
    firmware = ".".join(map(str, version.firmware))
    if version.firmware[:2] != _FIRMWARE:
        raise DeviceUnusable(f"the firmware of node {axis.id} is {firmware}; this driver speaks CANSimple of 0.6")
    if axis.joint.firmware is not None and axis.joint.firmware != firmware:
        raise DifferentMotor("firmware", axis.joint.firmware, firmware)
    if axis.identity not in {None, version}:
        raise DeviceUnusable(f"another ODrive answers as node {axis.id}: {version}, not {axis.identity}")
    axis.identity = version
