"""The execution of a trajectory on one bus: each cycle sends the set-points due and compares each joint with them."""

from collections.abc import Sequence
from typing import Final

from trade.errors import ConfigurationError, MotionStopped, ToleranceExceeded, TradeError, TrajectoryPart
from trade_drivers.bus._gate import Terms
from trade_drivers.bus._jobs import Steps
from trade_drivers.joints._axis import AxisT, Goal
from trade_drivers.joints._cycle import ControlMode, Exchange, Motion
from trade_drivers.motion._plan import Plan

_VALID_NS: Final = 200_000_000
"""The validity of a sent goal, as for a set-point; the trajectory ends if no goal is sent for longer."""
_NO_DEADLINE_NS: Final = 2**63


class Follow(Motion[AxisT]):
    """The execution of a plan for some joints of this bus.

    A device that interpolates gets the position due when it arrives there. Any other device brakes for each goal. So
    its goal is the point where the joint would come to rest if it braked at that time: it keeps its planned speed, and
    comes to rest within its range if no goal follows.
    """

    control_mode = ControlMode.POSITIONS

    def __init__(
        self,
        exchange: Exchange[AxisT],
        axes: Sequence[AxisT],
        plan: Plan,
        terms: Terms,
    ) -> None:
        super().__init__(exchange, axes, terms)
        self._plan = plan
        self._curves = {axis: track.curve for axis, track in zip(axes, plan.tracks, strict=True)}
        self._goals: dict[AxisT, int] = {}
        self._sent_ns = 0
        """When the goals due were last sent."""
        self.final_rad: list[float] = []

    def goal_of(self, axis: AxisT) -> int:
        return self._goals[axis]

    def gate(self) -> None:
        super().gate()
        if (failed := self._plan.course.failed) is not None:
            raise MotionStopped(
                device=self.devices[0].name, reason=f"another bus of its group could not go on: {failed}"
            )

    def steps(self) -> Steps:
        self._check_rate()
        yield from super().steps()

    def launch(self) -> None:
        exchange, now_ns = self.exchange, self.exchange.clock()
        for axis in self.devices:
            axis.check_usable(now_ns, exchange.stale_after_ns)
            if problem := self._astray(axis, "start", self._plan.tolerances.start_rad):
                raise problem
        goals = self._due(now_ns)
        whole = {axis: Goal(goal, axis.accel_counts, axis.speed_counts) for axis, goal in goals.items()}
        exchange.write_goals(whole, self.gate)
        self._goals = goals
        exchange.take_over(self)
        self.expires_ns = _NO_DEADLINE_NS  # it started in time; its duration is checked separately
        self._sent_ns = now_ns
        self._plan.course.ready(now_ns)

    def watch(self, now_ns: int) -> None:
        try:
            self.gate()
            if ending := self.trouble(now_ns, self.until_ns) or self._trouble(now_ns):
                raise ending
            if self._over():
                self.final_rad = [axis.scale.angle_rad(axis.sample.position) for axis in self.devices if axis.sample]
                self.exchange.release(self, None)
                return
            self._send(now_ns)
        except TradeError as ending:
            self._plan.course.fail(ending)
            self.exchange.release(self, ending)

    def _check_rate(self) -> None:
        """Raises ``ConfigurationError`` if the bus cannot send goals fast enough."""
        exchange, cycles = self.exchange, self.exchange.cycles_a_goal(self.devices)
        if (every_ns := cycles * exchange.period_ns) > _VALID_NS:
            problem = f"its joints take a goal every {every_ns / 1e9:.2g} s; a trajectory needs one every 0.2 s"
            needed = f"set the bus's rate_hz to {cycles * 1e9 / _VALID_NS:g} or more"
            raise ConfigurationError(where=f"bus {self.devices[0].bus}", problem=f"{problem}; {needed}")

    def _send(self, now_ns: int) -> None:
        goals = self._due(now_ns)
        if goals != self._goals:
            if not self.exchange.can_take_goals(self.devices):
                return
            self.exchange.write_positions(goals, self.gate)
            self._goals = goals
        self._sent_ns = now_ns

    def _due(self, now_ns: int) -> dict[AxisT, int]:
        """Returns the goals due now, in counts, limited to each joint's range, extended to a start outside it."""
        reached_ns = self.exchange.reached_ns(self.devices)
        elapsed_s = self._plan.course.elapsed_s(now_ns if reached_ns is None else reached_ns)
        goals: dict[AxisT, int] = {}
        for axis, curve in self._curves.items():
            position, velocity = curve.at(elapsed_s)
            braking = velocity * abs(velocity) / (2 * axis.joint.max_accel_rad_s2) if reached_ns is None else 0.0
            start = round(axis.scale.counts(curve.at(0)[0]))
            goal = round(axis.scale.counts(position + braking))
            goals[axis] = max(min(axis.low, start), min(max(axis.high, start), goal))
        return goals

    def _trouble(self, now_ns: int) -> TradeError | None:
        if (held_up_ns := now_ns - self._sent_ns) > _VALID_NS:
            reason = f"its bus was held up, or accepted no goal: it got no set-point for {held_up_ns / 1e9:.2g} s"
            return MotionStopped(device=self.devices[0].name, reason=reason)
        tolerance_rad = self._plan.tolerances.path_rad
        return next((problem for axis in self.devices if (problem := self._astray(axis, "path", tolerance_rad))), None)

    def _over(self) -> bool:
        """Returns whether all joints are at rest at the end; raises if they are not after the allowed time."""
        seen_ns = min(axis.sample.at_ns if axis.sample else 0 for axis in self.devices)
        late_s = self._plan.course.elapsed_s(seen_ns) - self._plan.course.duration_s
        if late_s < 0:
            return False
        tolerances = self._plan.tolerances
        off = [problem for axis in self.devices if (problem := self._astray(axis, "goal", tolerances.goal_rad))]
        moving = [axis for axis in self.devices if axis.still < 2]
        if late_s > tolerances.goal_time_s and (off or moving):
            raise off[0] if off else moving[0].fault_error("it does not come to rest at the end of its trajectory")
        return not off and not moving

    def _astray(self, axis: AxisT, what: TrajectoryPart, tolerance_rad: float) -> ToleranceExceeded | None:
        """Returns the error for a joint whose newest measurement is too far from its set-point of that time."""
        if (sample := axis.sample) is None:
            return None
        should_rad, _ = self._curves[axis].at(self._plan.course.elapsed_s(sample.at_ns))
        error_rad = axis.scale.angle_rad(sample.position) - should_rad
        self._plan.course.note(axis.name, error_rad)
        if abs(error_rad) <= tolerance_rad:
            return None
        return ToleranceExceeded(
            device=axis.name, bus=axis.bus, what=what, error_rad=error_rad, tolerance_rad=tolerance_rad
        )
