"""The cyclic exchange with the drives of a bus: heartbeat, SYNC, measurements, handshakes; commands, step by step."""

import logging
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Final

from trade.errors import DeviceSilent
from trade_drivers.bus._cycle import HALT_NS, PROBE_NS
from trade_drivers.bus.can import Frame
from trade_drivers.joints import AwaitedJob, ControlMode, Gate, Goal, Motion, Steps, next_measurement, until
from trade_drivers.joints.can._cycle import MotorExchange
from trade_drivers.vendors.cia402 import _table as table
from trade_drivers.vendors.cia402._axis import DriveAxis, Following, Stage, Turning
from trade_drivers.vendors.cia402._table import DictionaryEntry, State
from trade_drivers.vendors.cia402._verify import Admission, check_bus, heartbeat_ms
from trade_drivers.vendors.cia402._wire import DriveRefused, Net, NoAnswer
from trade_robotfile import CanBus

if TYPE_CHECKING:
    from trade_drivers.bus.can import CanPort

_log = logging.getLogger("trade")
_BEATS_MISSED: Final = 3
_MEASURED: Final = (Stage.SET_UP, Stage.HERE)
_WAIT_S: Final = 0.001
_TAKEN_BACK_NS: Final = 5_000_000_000
_AT_REST: Final = 2
"""Consecutive measurements without motion."""
_HANDSHAKE: Final = 3
"""Cycles of a set-point in profile position: bit raised, acknowledged, lowered."""


class DriveExchange(MotorExchange[DriveAxis]):
    """The exchange with the drives of one bus."""

    axis_type = DriveAxis
    check_bus = staticmethod(check_bus)
    again_ns = PROBE_NS

    def __init__(
        self, port: "CanPort", bus: CanBus, axes: Sequence[DriveAxis], clock: Callable[[], int] | None = None
    ) -> None:
        super().__init__(port, bus, axes, clock)
        self.nodes = Net(self.net)
        self.admissions = tuple(Admission(self, self.nodes, axis, bus, self.beat_next) for axis in axes)
        self._bus = bus
        self._beat_ns = int(bus.watchdog_s * 1e9 / 5)
        self._beaten_ns = 0
        self._synced_ns = self.clock()
        self.silent_after_ns = _BEATS_MISSED * heartbeat_ms(bus) * 1_000_000
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
                    self.command(axis, table.GO, position)
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
            if axis.stream is not None or axis.controlword == table.QUICK_STOP:
                self._quick_stop(axis)
            elif axis.state_now is State.ENABLED:
                self.port.send(table.BRAKING.base + axis.id, axis.braking(axis.accel_counts))
                self.command(axis, table.HOLD, position)

    def _quick_stop(self, axis: DriveAxis) -> None:
        """Requires a new enable(), since a target other than the last one would be a jump."""
        target = axis.stream.target if isinstance(axis.stream, Following) else None
        axis.stream, axis.ready = None, False
        if axis.state_now is State.ENABLED:
            self.command(axis, table.QUICK_STOP, target)

    def require_answering(self, axis: DriveAxis) -> None:
        if axis.silent:
            raise axis.absence(self.clock())

    def recall(self, axis: DriveAxis) -> None:
        """Restarts a drive that network management has stopped."""
        self.admissions[self.devices.index(axis)].recall()

    def mode_for(self, job: AwaitedJob[DriveAxis], axis: DriveAxis) -> int:
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

    # --- commands, one exchange after the other

    def making_way(self, job: Motion[DriveAxis]) -> Steps:
        for axis in job.devices:
            if axis.entered != self.mode_for(job, axis):
                yield from self.resting(job, axis)
                yield from self.enabling(job, axis)
            elif axis.stream is None:
                yield from until(self, axis, lambda: axis.can_take_goal, "it does not end its last handshake")  # noqa: B023 - over before the next

    def enabling(self, job: AwaitedJob[DriveAxis], axis: DriveAxis) -> Steps:
        """Switches torque on at the measured position, halted or with that as its target; confirms each step.

        A drive that is already enabled must be at rest: then only its mode changes. A homing ends.
        """
        mode = self.mode_for(job, axis)
        if axis.stopped:
            yield from self._take_back(job, axis)
        yield from self.looking(axis)
        axis.check_zero()
        axis.check_place(axis.fresh(self.clock(), self.stale_after_ns))
        if axis.motion is not None and not axis.fault:
            self.end_motion(axis, f"{axis.name} was enabled again")
        if not axis.statusword & table.REMOTE:
            raise axis.fault_error("it does not obey the bus (statusword bit 9), as if operated from its panel")
        if axis.state_now is State.FAULT:
            yield from self._reset(job, axis)
        yield from self._begin_at_rest(job, axis)
        yield from self.set_mode(job, axis, mode)
        for entry, value in (
            (table.PROFILE_VELOCITY, axis.speed_counts),
            (table.ACCELERATION, axis.accel_counts),
            (table.DECELERATION, axis.accel_counts),
        ):
            yield from self.write(job, axis, entry, value)
        yield from self._climb(job, axis, mode)
        axis.fault, axis.ready, axis.entered, axis.raised_ns = "", True, mode, 0
        axis.stream = self.stream_for(axis, mode, axis.target)

    def _take_back(self, job: AwaitedJob[DriveAxis], axis: DriveAxis) -> Steps:
        """Restarts a drive stopped by network management, and sets it up like one that was offline."""
        give_up_ns = self.clock() + _TAKEN_BACK_NS
        axis.recalled = True
        try:
            while axis.silent:
                job.gate()
                if self.clock() > give_up_ns:
                    raise axis.absence(self.clock())
                self.recall(axis)
                self.idle(_WAIT_S)
                yield
        finally:
            axis.recalled = False
        job.note("taken back from network management's stop: pre-operational, and set up")

    def _begin_at_rest(self, job: AwaitedJob[DriveAxis], axis: DriveAxis) -> Steps:
        """Clears old targets, which could move it in another mode."""
        if axis.may_hold_torque:
            yield from until(
                self, axis, lambda: axis.still >= _AT_REST, "its mode cannot be changed while it moves", HALT_NS
            )
        sample = axis.fresh(self.clock(), self.stale_after_ns)
        job.gate()
        self.port.send(table.BRAKING.base + axis.id, axis.braking(axis.accel_counts))
        if axis.state_now is State.ENABLED:
            target = axis.stream.target if isinstance(axis.stream, Following) else sample.position
            self.command(axis, table.HOLD, target)
        axis.entered, axis.stream = 0, None

    def resting(self, job: AwaitedJob[DriveAxis], axis: DriveAxis) -> Steps:
        """Ends its motion on the drive's own ramp."""
        job.gate()
        self.halt([axis], "another kind of motion took over")
        yield from until(self, axis, lambda: axis.still >= _AT_REST, "a halt was sent, but it is still moving", HALT_NS)

    def _climb(self, job: AwaitedJob[DriveAxis], axis: DriveAxis, mode: int) -> Steps:
        """Steps through the states to enabled, with the measured position as goal.

        The drive is then halted, except in a mode without a goal, where not all drives support halt.
        """
        while True:
            yield from until(
                self, axis, lambda: table.command_towards_enabled(axis.state_now) is not None, _stays(axis)
            )
            word = table.command_towards_enabled(axis.state_now) or 0
            if mode != table.PROFILE_POSITION:
                word &= ~table.HALT
            sample = axis.fresh(self.clock(), self.stale_after_ns)
            before = axis.state_now
            job.gate()
            self.command(axis, word, sample.position)
            if before is State.ENABLED:
                return
            yield from until(self, axis, lambda: axis.state_now is not before, _stays(axis))  # noqa: B023 - over before the next round

    def _reset(self, job: AwaitedJob[DriveAxis], axis: DriveAxis) -> Steps:
        """Clears the drive's own fault, without enabling it."""
        for word in (table.DISABLE_VOLTAGE, table.RESET_FAULT):
            job.gate()
            self.command(axis, word)
            yield from next_measurement(self, axis)
        stays = f"its fault cannot be cleared: {axis.fault or 'it stays'}"
        yield from until(self, axis, lambda: axis.state_now is not State.FAULT, stays)

    def set_mode(self, job: AwaitedJob[DriveAxis], axis: DriveAxis, mode: int) -> Steps:
        """Changes the mode of operation, and waits until the drive reports it."""
        yield from self.write(job, axis, table.MODE, mode)
        yield from until(self, axis, lambda: axis.mode == mode, f"it does not enter mode {mode} (6061h)")

    def relaxing(self, job: AwaitedJob[DriveAxis], axis: DriveAxis) -> Steps:
        """Switches torque off; the watchdog stays armed."""
        axis.ready = False
        if axis.may_hold_torque:
            job.gate()
            self.command(axis, table.DISABLE_VOLTAGE)
        yield from until(self, axis, lambda: not axis.may_hold_torque, "it did not relax: its torque is still on")

    def leaving(self, job: AwaitedJob[DriveAxis], axis: DriveAxis, *, relax: bool) -> Steps:
        """Switches torque off, or leaves it on for a joint seen at rest, and only then disarms the watchdog."""
        if relax:
            yield from self.relaxing(job, axis)
        elif axis.still == 0 and axis.may_hold_torque:
            return
        yield from self.write(job, axis, table.CONSUMER_HEARTBEAT, 0)
        axis.ready = False

    def write(self, job: AwaitedJob[DriveAxis], axis: DriveAxis, entry: DictionaryEntry, value: int) -> Steps:
        """Writes to its dictionary, with confirmation.

        Raises:
            DeviceFault: the drive refused.
            DeviceSilent: the drive did not answer.
        """
        began_ns = self.clock()
        self.require_answering(axis)
        try:
            for _ in self.nodes.write(axis.id, entry, value, job.gate):
                self.net.take_in(_WAIT_S)
                yield
                self.require_answering(axis)
        except NoAnswer:
            raise DeviceSilent(device=axis.name, bus=axis.bus, waited_s=(self.clock() - began_ns) / 1e9) from None
        except DriveRefused as refused:
            raise axis.fault_error(f"it refused a command: {refused}") from None

    # --- from the bus thread

    def on_open(self) -> None:
        for axis in self.devices:
            for data in self.port.sniffed.frames.get(table.HEARTBEAT + axis.id, ()):
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
        expected = [axis for axis in self.devices if not axis.silent]
        for axis in self.devices:
            if axis.stage in _MEASURED:
                axis.asked_ns = began_ns  # not the arrival, as a frozen process would take old values for new
        self.port.send(table.SYNC, b"")
        self.net.take_in(self.period_ns / 2e9, lambda: not any(axis.asked_ns for axis in expected))

    def after_measuring(self, now_ns: int) -> None:  # noqa: ARG002 - the same at any time
        """Lowers the bit of an acknowledged set-point, so that the next one has an edge."""
        for axis in self.devices:
            if axis.raised_ns and axis.acknowledged and axis.state_now is State.ENABLED:
                axis.raised_ns = 0
                self.command(axis, axis.controlword & ~table.NEW_SET_POINT)

    def admit(self) -> None:
        """Continues the admission of drives without waiting. An unhealthy process admits none (S06)."""
        if self.refusing is not None:
            return
        for admission in self.admissions:
            if admission.axis.stage is not Stage.HERE:
                admission.advance()


def _all_follow(axes: Sequence[DriveAxis]) -> bool:
    return all(table.CYCLIC_POSITION in axis.modes for axis in axes)


def _stays(axis: DriveAxis) -> str:
    if axis.fault and axis.state_now is State.FAULT:
        return axis.fault
    state = axis.state_now.name.lower().replace("_", " ") if axis.state_now else f"{axis.statusword:04X}h"
    return f"it cannot be enabled: it stays at {state}; is its power stage supplied, and its safe torque off released?"
