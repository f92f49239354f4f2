"""The cyclic exchange with all drives of one CAN bus: heartbeat, SYNC, measurements, handshakes, work."""

import logging
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Final

from trade_drivers.bus._cycle import PROBE_NS
from trade_drivers.bus.can import Frame
from trade_drivers.joints import ControlMode, Gate, Goal, Motion, Steps, Work, until
from trade_drivers.joints.can._cycle import MotorExchange
from trade_drivers.vendors.cia402 import _jobs as jobs
from trade_drivers.vendors.cia402 import _machine as machine
from trade_drivers.vendors.cia402 import _table as table
from trade_drivers.vendors.cia402._admission import Admission
from trade_drivers.vendors.cia402._axis import DriveAxis, Stage
from trade_drivers.vendors.cia402._inspect import heartbeat_ms
from trade_drivers.vendors.cia402._machine import State
from trade_drivers.vendors.cia402._net import Net
from trade_drivers.vendors.cia402._stream import Following, Turning

if TYPE_CHECKING:
    from trade_drivers.bus.can import CanPort
    from trade_robotfile import CanBus

_log = logging.getLogger("trade")
_BEATS_MISSED: Final = 3
_MEASURED: Final = (Stage.SET_UP, Stage.HERE)
_HANDSHAKE: Final = 3
"""Cycles of a set-point in profile position: bit raised, acknowledged, lowered."""


class DriveExchange(MotorExchange[DriveAxis]):
    """The exchange with the drives of one bus."""

    again_ns = PROBE_NS

    def __init__(
        self, port: "CanPort", bus: "CanBus", axes: Sequence[DriveAxis], clock: Callable[[], int] | None = None
    ) -> None:
        super().__init__(port, bus, axes, clock)
        self.nodes = Net(self.net)
        self.admissions = tuple(Admission(self, axis, bus) for axis in axes)
        self._bus = bus
        self._beat_ns = int(bus.watchdog_s * 1e9 / 5)
        self._beaten_ns = 0
        self._synced_ns = self.clock()
        self.deaf_ns = _BEATS_MISSED * heartbeat_ms(bus) * 1_000_000
        self.rival = False
        """True if the heartbeats of another driver were received."""
        self.net.hear(table.HEARTBEAT + table.OUR_NODE, self._hear_rival)
        for axis in axes:
            self._listen_to(axis)

    def _hear_rival(self, _: bytes) -> None:
        if not self.rival:
            _log.error("%s: another driver commands the drives of this bus, too", self.port.path)
        self.rival = True

    def _listen_to(self, axis: DriveAxis) -> None:
        self.net.hear(table.STATUS.base + axis.id, lambda data: axis.take_status(data, self.clock()))
        self.net.hear(table.MOTION.base + axis.id, axis.take_motion)
        self.net.hear(table.EMERGENCY + axis.id, axis.take_emergency)
        self.net.hear(table.HEARTBEAT + axis.id, lambda data: axis.take_heartbeat(data, self.clock()))

    # --- commands

    def command(self, axis: DriveAxis, controlword: int, target: int | None = None) -> None:
        """Sends a controlword with a target."""
        axis.controlword = controlword
        axis.target = axis.target if target is None else target
        self.port.send(table.COMMAND.base + axis.id, table.COMMAND.layout.pack(controlword, axis.target))

    def write_goals(self, goals: Mapping[DriveAxis, Goal], gate: Gate) -> None:
        """Sends the ramps, which move nothing; then, after the gate, starts all joints together."""
        for axis, goal in goals.items():
            if axis.stream is None:
                self.port.send(table.PROFILE.base + axis.id, table.PROFILE.layout.pack(goal.speed, goal.accel))
                self.port.send(table.BRAKING.base + axis.id, axis.braking(goal.accel))
            elif isinstance(axis.stream, Turning):
                axis.stream.fastest = goal.speed
        self.write_positions({axis: goal.position for axis, goal in goals.items()}, gate)

    def write_positions(self, positions: Mapping[DriveAxis, int], gate: Gate) -> None:
        gate()
        for axis, position in positions.items():
            match axis.stream:
                case None:
                    axis.raised_ns = self.clock()
                    self.command(axis, machine.GO, position)
                case Following() as following:
                    following.aim = position
                case Turning() as turning:
                    turning.end = position

    def cycles_a_goal(self, axes: Sequence[DriveAxis]) -> int:
        return 1 if _all_follow(axes) else _HANDSHAKE

    def reached_ns(self, axes: Sequence[DriveAxis]) -> int | None:
        """A set-point takes effect at the next SYNC, and is reached a period later."""
        return self._synced_ns + 2 * self.period_ns if _all_follow(axes) else None

    def can_take_goals(self, axes: Sequence[DriveAxis]) -> bool:
        return all((axis.stream or axis.can_take_goal) and not self.worked_on(axis) for axis in axes)

    def write_holds(self, positions: Mapping[DriveAxis, int]) -> None:
        """Halts drives on the joint's ramp; skips those not known to be enabled, as the frame could enable them.

        In a mode without a goal, it is a quick stop, which the drive executes itself, and which keeps torque on.
        """
        for axis, position in positions.items():
            axis.raised_ns = 0
            if axis.stream is not None or axis.controlword == machine.QUICK_STOP:
                self._quick_stop(axis)
            elif axis.state_now is State.ENABLED:
                self.port.send(table.BRAKING.base + axis.id, axis.braking(axis.accel_counts))
                self.command(axis, machine.HOLD, position)

    def _quick_stop(self, axis: DriveAxis) -> None:
        """Requires a new enable(), since a target other than the last one would be a jump."""
        target = axis.stream.target if isinstance(axis.stream, Following) else None
        axis.stream, axis.ready = None, False
        if axis.state_now is State.ENABLED:
            self.command(axis, machine.QUICK_STOP, target)

    def enabling(self, job: Work[DriveAxis], axis: DriveAxis) -> Steps:
        return jobs.enabling(self, job, axis, self.mode_for(job, axis))

    def require_answering(self, axis: DriveAxis) -> None:
        if axis.silent:
            raise axis.absence(self.clock())

    def recall(self, axis: DriveAxis) -> None:
        """Restarts a drive that network management has stopped."""
        self.admissions[self.devices.index(axis)].recall()

    def mode_for(self, job: Work[DriveAxis], axis: DriveAxis) -> int:
        """Returns the mode of operation for a job's commands to this drive."""
        match job.control_mode if isinstance(job, Motion) else ControlMode.GOALS:
            case ControlMode.POSITIONS if _all_follow(job.devices):
                return table.CYCLIC_POSITION
            case ControlMode.SPEEDS:
                return axis.turning_mode
            case _:
                return table.PROFILE_POSITION

    def stream_for(self, axis: DriveAxis, mode: int, position: int) -> Following | Turning | None:
        """Returns the set-point generator for a drive at rest at this position."""
        period_s = self.period_ns / 1e9
        match mode:
            case table.CYCLIC_POSITION:
                speed, accel = (
                    axis.joint.max_speed_rad_s / axis.resolution.rad,
                    axis.joint.max_accel_rad_s2 / axis.resolution.rad,
                )
                return Following(axis.id, position, speed=speed, accel=accel, period_s=period_s)
            case table.CYCLIC_VELOCITY | table.PROFILE_VELOCITY_MODE:
                blind_s = self._bus.watchdog_s + 2 * period_s
                resolution = axis.resolution
                return Turning(
                    axis.id,
                    accel=axis.accel_counts,
                    period_s=period_s,
                    blind_s=blind_s,
                    speed_unit=resolution.rad_s / resolution.rad,
                    accel_unit=resolution.rad_s2 / resolution.rad,
                )
            case _:
                return None

    def relaxing(self, job: Work[DriveAxis], axis: DriveAxis) -> Steps:
        return jobs.relaxing(self, job, axis)

    def looking(self, axis: DriveAxis) -> Steps:
        return jobs.looking(self, axis)

    def making_way(self, job: Motion[DriveAxis]) -> Steps:
        for axis in job.devices:
            if axis.entered != self.mode_for(job, axis):
                yield from jobs.resting(self, job, axis)
                yield from self.enabling(job, axis)
            elif axis.stream is None:
                yield from until(self, axis, lambda: axis.can_take_goal, "it does not end its last handshake")  # noqa: B023 - over before the next

    def leaving(self, job: Work[DriveAxis], axis: DriveAxis, *, relax: bool) -> Steps:
        return jobs.leaving(self, job, axis, relax=relax)

    # --- from the bus thread

    def opened(self) -> None:
        for axis in self.devices:
            for data in self.port.talk.frames.get(table.HEARTBEAT + axis.id, ()):
                axis.take_heartbeat(data, self.clock())

    def cycle(self) -> None:
        """Runs one cycle: stops, heartbeat, measurements, handshakes, work, motions, streams."""
        super().cycle()
        self._stream()

    def _stream(self) -> None:
        """Sends each drive in a mode without a goal its next set-point, even without a motion."""
        now_ns = self.clock()
        frames = [
            Frame(axis.stream.can_id, axis.stream.next(axis.sample, now_ns))
            for axis in self.devices
            if axis.stream is not None and axis.ready and axis.sample is not None and not axis.silent
        ]
        if frames:
            self.port.send_all(frames)

    def _beat(self, now_ns: int) -> None:
        """Sends the heartbeat that feeds the drives' watchdogs."""
        if now_ns - self._beaten_ns >= self._beat_ns:
            self._beaten_ns = now_ns
            self.port.send(table.HEARTBEAT + table.OUR_NODE, bytes((table.OPERATIONAL,)))

    def beat_next(self) -> None:
        """Schedules a heartbeat for the next cycle: a drive monitors them only after the first one (CiA 301, 1016h)."""
        self._beaten_ns = 0

    def measure(self, began_ns: int) -> None:
        self._beat(began_ns)
        self._synced_ns = began_ns
        asked = [axis for axis in self.devices if not axis.silent]
        for axis in self.devices:
            if axis.stage in _MEASURED:
                axis.asked_ns = began_ns  # not the arrival, as a frozen process would take old values for new
        self.port.send(table.SYNC, b"")
        self.net.take_in(self.period_ns / 2e9, lambda: not any(axis.asked_ns for axis in asked))

    def after_measuring(self, now_ns: int) -> None:  # noqa: ARG002 - the same at any time
        """Lowers the bit of an acknowledged set-point, so that the next one has an edge."""
        for axis in self.devices:
            if axis.raised_ns and axis.acknowledged and axis.state_now is State.ENABLED:
                axis.raised_ns = 0
                self.command(axis, axis.controlword & ~machine.NEW_SET_POINT)

    def admit(self) -> None:
        """Continues the admission of drives without waiting. An unhealthy process admits none (S06)."""
        if self.refusing is not None:
            return
        for admission in self.admissions:
            if admission.axis.stage is not Stage.HERE:
                admission.advance()


def _all_follow(axes: Sequence[DriveAxis]) -> bool:
    return all(table.CYCLIC_POSITION in axis.modes for axis in axes)
