"""The exchange with the Damiao motors of a bus: its checks, and commands in each cycle and step by step.

A motor sends feedback only in answer to a frame. So each cycle sends a motor with torque its next set-point, and any
other motor a request. Its own ramps are unreliable, so this driver generates them.
"""

from collections.abc import Callable, Mapping, Sequence
from math import isclose
from typing import TYPE_CHECKING, Final

from trade.errors import TradeError
from trade_drivers.bus._cycle import HALT_NS
from trade_drivers.bus._jobs import NoAnswer
from trade_drivers.bus.can import Frame, frame_bits
from trade_drivers.joints import (
    AwaitedJob,
    ControlMode,
    DeviceUnusable,
    Gate,
    Goal,
    Motion,
    Ramp,
    Steps,
    check_joints,
    check_rate,
    next_measurement,
    until,
)
from trade_drivers.joints.can import DifferentMotor, check_keys, check_load
from trade_drivers.joints.can._cycle import MotorExchange
from trade_drivers.vendors.damiao import _frames as frames
from trade_drivers.vendors.damiao import _table as table
from trade_drivers.vendors.damiao._axis import DamiaoAxis
from trade_drivers.vendors.damiao._table import Register
from trade_robotfile import CanBus

if TYPE_CHECKING:
    from trade_drivers.bus.can import CanPort

_LAG: Final = 5
"""Cycles by which a motor may lag behind its set-point."""
_WAIT_S: Final = 0.001
_WITHIN: Final = 0.98
"""The share of a motor's position range that a joint may use, as positions at its two ends look alike."""


def check_bus(bus: CanBus, axes: Sequence[DamiaoAxis], where: str) -> None:
    """Checks the robot file: identifiers, keys, ranges, and whether a cycle is long enough for its frames.

    Raises:
        ConfigurationError: a check failed; names the key and the right value.
    """
    check_joints(axes, where, _check_joint)
    check_rate(bus, where, 4)
    check_load(bus, where, f"{len(axes)} motors", len(axes) * 2 * frame_bits(8))


def _check_joint(axis: DamiaoAxis) -> None:
    joint, ranges = axis.joint, axis.ranges
    if not 1 <= joint.id < table.MASTER:
        raise DeviceUnusable(f"{joint.id} is not valid; use 1 to 15 (the motor answers as its id plus 16)", ".id")
    if joint.max_speed_rad_s * joint.gear > ranges.velocity_rad_s:
        most = ranges.velocity_rad_s / joint.gear
        raise DeviceUnusable(
            f"{joint.max_speed_rad_s:.4g} is above {most:.4g}, the most a {joint.model} reports", ".max_speed_rad_s"
        )
    for key, value in ((".min_rad", joint.min_rad), (".max_rad", joint.max_rad)):
        if abs(axis.scale.counts(value)) * axis.resolution.rad * joint.gear > _WITHIN * ranges.position_rad:
            raise DeviceUnusable(f"{value:.4g} is farther from its zero than a {joint.model} can report", key)
    check_keys(axis, "a Damiao motor", "radians")


class DamiaoExchange(MotorExchange[DamiaoAxis]):
    """The exchange with the Damiao motors of one bus."""

    axis_type = DamiaoAxis
    check_bus = staticmethod(check_bus)

    def __init__(
        self, port: "CanPort", bus: CanBus, axes: Sequence[DamiaoAxis], clock: Callable[[], int] | None = None
    ) -> None:
        super().__init__(port, bus, axes, clock)
        self.timeout = round(bus.watchdog_s * table.TICKS_PER_S)
        self.silent_after_ns = self.stale_after_ns
        for axis in axes:
            self.net.hear(axis.master, self._listener(axis))

    def _listener(self, axis: DamiaoAxis) -> Callable[[bytes], None]:
        return lambda data: axis.take(data, self.clock())

    # --- commands

    def _set_point(self, axis: DamiaoAxis) -> Frame:
        """Returns the frame with the next set-point."""
        return Frame(table.POSITION_VELOCITY + axis.id, axis.step(self.lasting_clock(), self.period_ns / 1e9))

    def refresh(self, axis: DamiaoAxis) -> Frame:
        """Returns a request without a command."""
        return Frame(table.BROADCAST, frames.refresh(axis.id))

    def stand(self, axis: DamiaoAxis) -> None:
        """Starts set-points at the measured position."""
        axis.course = self._ramp_from(axis, axis.fresh(self.clock(), self.stale_after_ns).position)
        axis.stepped_ns = self.lasting_clock()

    def _ramp_from(self, axis: DamiaoAxis, position: int) -> Ramp:
        accel = float(axis.accel_counts)
        return Ramp(position, fastest=axis.speed_counts, accel=accel, braking=accel)

    def enable(self, axis: DamiaoAxis) -> None:
        """Switches torque on between set-points at the measured position, so that it does not move to an old one."""
        set_point = self._set_point(axis)
        self.port.send_all([set_point, Frame(axis.id, frames.ENABLE), set_point])

    def write_goals(self, goals: Mapping[DamiaoAxis, Goal], gate: Gate) -> None:
        for axis, goal in goals.items():
            if (course := axis.course) is not None:
                course.fastest, course.accel = goal.speed, goal.accel
                course.braking = goal.accel * axis.easing
        self._aim({axis: goal.position for axis, goal in goals.items()}, gate, Ramp.jump)

    def write_positions(self, positions: Mapping[DamiaoAxis, int], gate: Gate) -> None:
        self._aim(positions, gate, _go_on)

    def _aim(self, positions: Mapping[DamiaoAxis, int], gate: Gate, aim: Callable[[Ramp, int], None]) -> None:
        gate()
        frames_out: list[Frame] = []
        for axis, position in positions.items():
            if axis.course is None:
                raise axis.fault_error("it was enabled, but has let go since")
            aim(axis.course, position)
            frames_out.append(self._set_point(axis))
        self.port.send_all(frames_out)

    def reached_ns(self, axes: Sequence[DamiaoAxis]) -> int | None:  # noqa: ARG002 - the same for all
        """A set-point is reached within the period that begins with it."""
        return self.clock() + self.period_ns

    def write_holds(self, positions: Mapping[DamiaoAxis, int]) -> None:
        """Brakes at the joint's maximum deceleration; a joint held off its course stays where it is.

        Relaxes a motor whose torque this driver did not switch on, as its reaction to a position is unknown. Sends
        nothing after an interruption before a new measurement: the motor has stopped by itself, and where is unknown.
        """
        for axis, position in positions.items():
            if axis.course is None:
                if axis.torque:
                    self.port.send(axis.id, frames.DISABLE)
                continue
            if not self.held_up(axis.stepped_ns):
                self._brake(axis, axis.course, position)
            elif axis.age_ns(self.clock()) <= self.watchdog_ns:
                axis.course = self._ramp_from(axis, position)
            else:
                continue
            self.port.send_all([self._set_point(axis)])

    def _brake(self, axis: DamiaoAxis, course: Ramp, position: int) -> None:
        if abs(course.position - position) > axis.resolution.near + abs(course.speed) * _LAG * self.period_ns / 1e9:
            axis.course = self._ramp_from(axis, position)
            return
        course.accel = course.braking = axis.accel_counts
        rests = course.position + course.speed * abs(course.speed) / (2 * axis.accel_counts)
        course.jump(round(max(min(axis.low, course.position), min(max(axis.high, course.position), rests))))

    def making_way(self, job: Motion[DamiaoAxis]) -> Steps:
        for axis in job.devices:
            axis.easing = 0.5 if job.control_mode is ControlMode.POSITIONS else 1.0
        yield from ()

    # --- enabling, relaxing and leaving: one exchange after the other

    def enabling(self, job: AwaitedJob[DamiaoAxis], axis: DamiaoAxis) -> Steps:
        """Switches torque on at the measured position in position-velocity mode; confirms each step."""
        yield from self.looking(axis)
        if axis.motion is not None and not axis.fault:
            self.end_motion(axis, f"{axis.name} was enabled again")
        if axis.torque:
            yield from until(self, axis, lambda: axis.still > 1, "it cannot be enabled while it moves", HALT_NS)
        if axis.failed:
            job.gate()
            complaint = axis.complaint
            self.port.send(axis.id, frames.CLEAR)
            yield from until(self, axis, lambda: not axis.failed, f"{complaint}; it cannot be cleared")
        yield from self._set_up(job, axis)
        yield from next_measurement(self, axis)
        axis.check_zero()
        job.gate()
        self.stand(axis)
        self.enable(axis)
        yield from until(self, axis, lambda: axis.torque is True, "it cannot be enabled; is its power stage supplied?")
        axis.fault, axis.ready = "", True

    def _set_up(self, job: AwaitedJob[DamiaoAxis], axis: DamiaoAxis) -> Steps:
        """Compares its scale, sets timeout and mode, each time: a restart, which is not reported, may change all."""
        yield from self._run_requests(axis, self.check_ranges(axis))
        job.gate()
        yield from self._write(axis, Register.TIMEOUT, self.timeout)
        yield from self._run_requests(axis, self.register(axis, Register.CONTROL_MODE))
        if axis.answer == table.IN_POSITION_VELOCITY:
            return
        if axis.torque:  # it would move to its last set-point in that mode, however old
            yield from self.relaxing(job, axis)
        job.gate()
        yield from self._write(axis, Register.CONTROL_MODE, table.IN_POSITION_VELOCITY)

    def relaxing(self, job: AwaitedJob[DamiaoAxis], axis: DamiaoAxis) -> Steps:
        """Switches torque off, which also idles the watchdog."""
        axis.ready = False
        job.gate()
        axis.course = None
        if axis.may_hold_torque:
            self.port.send(axis.id, frames.DISABLE)
        yield from until(self, axis, lambda: not axis.may_hold_torque, "it did not relax: its torque is still on")

    def leaving(self, job: AwaitedJob[DamiaoAxis], axis: DamiaoAxis, *, relax: bool) -> Steps:
        """Switches torque off, or leaves it on for a joint seen at rest, and only then disarms the watchdog."""
        if relax:
            yield from self.relaxing(job, axis)
            return
        if axis.still == 0 and axis.may_hold_torque:
            return
        yield from self._write(axis, Register.TIMEOUT, 0)
        axis.ready, axis.course = False, None

    def _write(self, axis: DamiaoAxis, number: Register, value: int) -> Steps:
        """Writes a register and reads it back; raises ``DeviceFault`` if the value was not kept."""
        yield from self._run_requests(axis, self.set_register(axis, number, value))
        if axis.answer != value:
            raise axis.fault_error(f"it does not keep register {number:d}: {axis.answer}, not {value}")

    def _run_requests(self, axis: DamiaoAxis, asking: Steps) -> Steps:
        """Runs register exchanges; raises ``DeviceSilent`` for no answer, ``DeviceFault`` for ``DeviceUnusable``."""
        try:
            for _ in asking:
                self.idle(_WAIT_S)
                yield
        except NoAnswer:
            raise axis.silent_error(self.clock()) from None
        except DeviceUnusable as unfit:
            raise axis.fault_error(str(unfit)) from None

    # --- identity and settings

    def verify(self, axis: DamiaoAxis) -> Steps:
        """Checks the identity and ranges of a motor, and arms its watchdog. Enables and moves nothing.

        Raises:
            Unfit: the motor cannot be used.
            NoAnswer: the motor does not answer.
        """
        yield from self.check_ranges(axis)
        yield from self.register(axis, Register.SOFTWARE)
        if axis.software not in {None, axis.answer}:
            raise DeviceUnusable(
                f"another motor answers as {axis.id}: its software is {axis.answer}, not {axis.software}"
            )
        axis.software = int(axis.answer or 0)
        if axis.joint.firmware is not None and axis.joint.firmware != str(axis.software):
            raise DifferentMotor("firmware", axis.joint.firmware, str(axis.software))
        yield from self.set_register(axis, Register.TIMEOUT, self.timeout)
        if axis.answer != self.timeout:
            raise DeviceUnusable(f"it does not keep its time-out (register 9): {axis.answer}, not {self.timeout}")
        axis.heard_ns = 0
        yield from self.request(axis, [self.refresh(axis)], lambda: axis.heard_ns > 0)

    def check_ranges(self, axis: DamiaoAxis) -> Steps:
        """Compares the registers that scale positions, speeds and torques with those of the model.

        Raises:
            Unfit, NoAnswer: as for ``verify``.
        """
        for number, meant in zip(
            (Register.POSITION_MAX, Register.VELOCITY_MAX, Register.TORQUE_MAX), axis.ranges, strict=True
        ):
            yield from self.register(axis, number)
            if axis.answer is None or not isclose(axis.answer, meant, rel_tol=1e-3):
                name = number.name.replace("_MAX", "").lower()
                problem = f"the {name} of a {axis.joint.model} goes to {meant:g}, but motor {axis.id} is set to"
                raise DeviceUnusable(f"{problem} {axis.answer:g} (register {number:d})", ".model")

    def register(self, axis: DamiaoAxis, number: Register) -> Steps:
        """Requests a register; ``answer`` is then its value."""
        axis.answer, axis.asks = None, number
        question = Frame(table.BROADCAST, frames.read(axis.id, number))
        yield from self.request(axis, [question], lambda: axis.asks is None)

    def set_register(self, axis: DamiaoAxis, number: Register, value: int) -> Steps:
        """Writes a register and reads it back."""
        axis.answer, axis.asks = None, number
        order = Frame(table.BROADCAST, frames.write(axis.id, number, value))
        yield from self.request(axis, [order], lambda: axis.asks is None)
        yield from self.register(axis, number)

    # --- requests

    def question(self, axis: DamiaoAxis) -> Frame:
        """Returns the next set-point; a request only after an interruption, as the motor has stopped by itself."""
        if axis.course is None or self.held_up(axis.stepped_ns):
            return self.refresh(axis)
        return self._set_point(axis)

    def watch(self) -> None:
        """Ends motions whose call has ended, as their set-points are generated step by step."""
        super().watch()
        for motion in dict.fromkeys(axis.motion for axis in self.devices if axis.motion is not None):
            try:
                motion.permit.gate()
            except TradeError as ending:
                self.release(motion, ending)


def _go_on(course: Ramp, aim: int) -> None:
    course.aim = aim
