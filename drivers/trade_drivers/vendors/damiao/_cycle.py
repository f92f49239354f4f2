"""Commands to Damiao motors in the cyclic exchange with a bus.

A motor sends feedback only in answer to a frame. So each cycle sends a motor with torque its next set-point, and any
other motor a request. Its own ramps are unreliable, so this driver generates them.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Final

from trade.errors import TradeError
from trade_drivers.bus.can import Frame
from trade_drivers.joints import ControlMode, Gate, Goal, Motion, Ramp, Steps, Work, next_measurement
from trade_drivers.joints.can._cycle import MotorExchange
from trade_drivers.vendors.damiao import _frames as frames
from trade_drivers.vendors.damiao import _jobs as jobs
from trade_drivers.vendors.damiao._axis import DamiaoAxis
from trade_drivers.vendors.damiao._inspect import look_over

if TYPE_CHECKING:
    from trade_drivers.bus.can import CanPort
    from trade_robotfile import CanBus

_LAG: Final = 5
"""Cycles by which a motor may lag behind its set-point."""


class DamiaoExchange(MotorExchange[DamiaoAxis]):
    """The exchange with the Damiao motors of one bus."""

    def __init__(
        self, port: "CanPort", bus: "CanBus", axes: Sequence[DamiaoAxis], clock: Callable[[], int] | None = None
    ) -> None:
        super().__init__(port, bus, axes, clock)
        self.timeout = round(bus.watchdog_s * frames.TICKS_PER_S)
        self.deaf_ns = self.stale_after_ns
        for axis in axes:
            self.net.hear(axis.master, self._listener(axis))

    def _listener(self, axis: DamiaoAxis) -> Callable[[bytes], None]:
        return lambda data: axis.take(data, self.clock())

    # --- commands

    def _there(self, axis: DamiaoAxis) -> Frame:
        """Returns the frame with the next set-point."""
        return Frame(frames.POSITION_VELOCITY + axis.id, axis.step(self.lasting_clock(), self.period_ns / 1e9))

    def refresh(self, axis: DamiaoAxis) -> Frame:
        """Returns a request without a command."""
        return Frame(frames.BROADCAST, frames.refresh(axis.id))

    def stand(self, axis: DamiaoAxis) -> None:
        """Starts set-points at the measured position."""
        axis.course = self._standing(axis, axis.fresh(self.clock(), self.stale_after_ns).position)
        axis.stepped_ns = self.lasting_clock()

    def _standing(self, axis: DamiaoAxis, position: int) -> Ramp:
        accel = float(axis.accel_counts)
        return Ramp(position, fastest=axis.speed_counts, accel=accel, braking=accel)

    def enable(self, axis: DamiaoAxis) -> None:
        """Switches torque on between set-points at the measured position, so that it does not move to an old one."""
        there = self._there(axis)
        self.port.send_all([there, Frame(axis.id, frames.ENABLE), there])

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
                raise axis.faulty("it was enabled, but has let go since")
            aim(axis.course, position)
            frames_out.append(self._there(axis))
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
                axis.course = self._standing(axis, position)
            else:
                continue
            self.port.send_all([self._there(axis)])

    def _brake(self, axis: DamiaoAxis, course: Ramp, position: int) -> None:
        if abs(course.position - position) > axis.resolution.near + abs(course.speed) * _LAG * self.period_ns / 1e9:
            axis.course = self._standing(axis, position)
            return
        course.accel = course.braking = axis.accel_counts
        rests = course.position + course.speed * abs(course.speed) / (2 * axis.accel_counts)
        course.jump(round(max(min(axis.low, course.position), min(max(axis.high, course.position), rests))))

    def making_way(self, job: Motion[DamiaoAxis]) -> Steps:
        for axis in job.devices:
            axis.easing = 0.5 if job.control_mode is ControlMode.POSITIONS else 1.0
        yield from ()

    def enabling(self, job: Work[DamiaoAxis], axis: DamiaoAxis) -> Steps:
        return jobs.enabling(self, job, axis)

    def relaxing(self, job: Work[DamiaoAxis], axis: DamiaoAxis) -> Steps:
        return jobs.relaxing(self, job, axis)

    def looking(self, axis: DamiaoAxis) -> Steps:
        self.require_answering(axis)
        yield from next_measurement(self, axis)

    def leaving(self, job: Work[DamiaoAxis], axis: DamiaoAxis, *, relax: bool) -> Steps:
        return jobs.leaving(self, job, axis, relax=relax)

    # --- requests

    def question(self, axis: DamiaoAxis) -> Frame:
        """Returns the next set-point; a request only after an interruption, as the motor has stopped by itself."""
        if axis.course is None or self.held_up(axis.stepped_ns):
            return self.refresh(axis)
        return self._there(axis)

    def look_over(self, axis: DamiaoAxis) -> Steps:
        return look_over(self, axis)

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
