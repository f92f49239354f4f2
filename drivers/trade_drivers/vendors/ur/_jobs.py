"""Jobs of services for the bus thread: moves, set-points, freedrive, the speed slider."""

from collections.abc import Sequence
from typing import Final

from trade.errors import InvalidArgument, LimitExceeded, MotionStopped, ToleranceExceeded, TradeError, TrajectoryPart
from trade_drivers.bus._gate import Command, Terms
from trade_drivers.bus._jobs import Steps
from trade_drivers.motion._plan import Plan
from trade_drivers.vendors.ur._arm_state import ArmStatus
from trade_drivers.vendors.ur._exchange import Exchange
from trade_drivers.vendors.ur._messages import Free, MoveJoints, MoveLine, Sample, Solve
from trade_drivers.vendors.ur._path import SetpointFilter, poses_on

_NEAR: Final = 0.01
"""Distance in rad or m within which a move has arrived."""
_OUTSIDE_RAD: Final = 0.02
"""The distance in rad that a joint may be measured outside its range without a command to leave it."""
_STUCK_NS: Final = 1_000_000_000
"""The time within which a running move must change the measurement."""
_NO_DEADLINE_NS: Final = 2**63
_HELD_UP_NS: Final = 200_000_000


class ArmCommand(Command[ArmStatus, Exchange]):
    """A command to the arm of a controller."""

    def __init__(self, exchange: Exchange, terms: Terms) -> None:
        super().__init__(exchange, [exchange.limb], terms)
        self.limb = exchange.limb

    def usable(self) -> Sample:
        """Returns the newest measurement of an arm that may be commanded; raises as ``ArmStatus.check_usable``."""
        return self.limb.check_usable(self.exchange.clock(), self.exchange.stale_after_ns)


class Scaling(ArmCommand):
    """Set the speed slider."""

    def __init__(self, exchange: Exchange, fraction: float, terms: Terms) -> None:
        super().__init__(exchange, terms)
        self._fraction = fraction

    def steps(self) -> Steps:
        self.limb.fresh(self.exchange.clock(), self.exchange.stale_after_ns)
        yield from self.exchange.scaling(self, self._fraction, self.expires_ns)


class EndFreedrive(ArmCommand):
    """Ends freedrive: the arm holds itself again."""

    def steps(self) -> Steps:
        if isinstance(self.limb.motion, Freedrive):
            self.gate()
            yield from self.exchange.making_way()


class Motion(ArmCommand):
    """A command that moves the arm, and is watched until it ends."""

    streams = False
    """True for a stream of set-points, which must also be ended after success."""
    attended_ns = 0
    """When it was last checked, by the lasting clock."""

    def watch(self, now_ns: int) -> None:
        """Checks the newest measurement, and ends the motion if it is over or must not continue."""
        raise NotImplementedError

    def trouble(self, now_ns: int, until_ns: int | None) -> TradeError | None:
        """Returns why the motion must end: an interrupted driver, no answer, a fault, or the call's deadline."""
        attended_ns, self.attended_ns = self.attended_ns, self.exchange.lasting_clock()
        if held_up := self.exchange.held_up(attended_ns):
            return self.limb.fault_error(f"{self.limb.fault}; {held_up}" if self.limb.fault else held_up)
        try:
            self.usable()
        except TradeError as problem:
            return problem
        if until_ns is not None and now_ns >= until_ns:
            reason, slowed = "its call reached its deadline", self.limb.slowed
            return MotionStopped(device=self.limb.name, reason=f"{reason}; {slowed}" if slowed else reason, late=True)
        return None

    def astray(self, sample: Sample) -> LimitExceeded | None:
        """Returns the error for a joint outside its range that moves further out. (It may move back inside.)"""
        arm = self.limb.arm
        spans = zip(self.limb.joints, sample.positions, sample.speeds, arm.min_rad, arm.max_rad, strict=True)
        for name, angle, speed, low, high in spans:
            if (angle > high + _OUTSIDE_RAD and speed > 0) or (angle < low - _OUTSIDE_RAD and speed < 0):
                return LimitExceeded(what=f"{name}, measured", value=angle, lower=low, upper=high, unit="rad")
        return None

    def done_stepping(self) -> None:
        """Does nothing: the motion is watched until it ends. (It has already ended if it was refused.)"""

    def beginning(self) -> Steps:
        """Takes control, and waits until the arm is at rest."""
        self.usable()
        self.gate()
        yield from self.exchange.taking_control(self)
        yield from self.exchange.making_way()
        self.usable()


class Freedrive(Motion):
    """Freedrive: the arm can be moved by hand until a client ends it; the service returns immediately."""

    def steps(self) -> Steps:
        yield from self.beginning()
        self.exchange.take_over(self)
        try:
            yield from self.exchange.carrying_out(self, lambda number: Free(number=number, expires_ns=self.expires_ns))
        except TradeError as problem:
            self.exchange.release(self, problem)
            raise
        self.expires_ns = _NO_DEADLINE_NS
        self.finish()

    def watch(self, now_ns: int) -> None:  # noqa: ARG002 - the gate looks at the clock itself
        try:
            self.gate()
            self.usable()
        except TradeError as ending:
            self.exchange.release(self, ending)


class Move(Motion):
    """A move with an end, in joint space."""

    def __init__(
        self,
        exchange: Exchange,
        goal: Sequence[float],
        speed: float,
        terms: Terms,
    ) -> None:
        super().__init__(exchange, terms)
        self.goal = list(goal)
        self.speed = speed
        self._answers_before = -1
        """Number of its process's answers to heartbeats when it began."""
        self._place: list[float] = []
        self._moved_ns = 0

    def order(self, number: int) -> MoveJoints | MoveLine:
        """Returns the order to send."""
        accel = self.limb.arm.max_accel_rad_s2
        return MoveJoints(number=number, expires_ns=self.expires_ns, positions=self.goal, speed=self.speed, accel=accel)

    def off(self, sample: Sample) -> float:
        """Returns the distance to its goal."""
        return max(abs(a - b) for a, b in zip(sample.positions, self.goal, strict=True))

    def steps(self) -> Steps:
        yield from self.beginning()
        self.exchange.take_over(self)
        try:
            yield from self.exchange.carrying_out(self, self.order)
        except TradeError as problem:
            self.exchange.release(self, problem)
            raise
        self.note("began its move")
        self.attended_ns = self.exchange.lasting_clock()
        control = self.exchange.link.control
        self._answers_before = 0 if control is None else control.heartbeat_answers

    def watch(self, now_ns: int) -> None:
        control, sample = self.exchange.link.control, self.limb.sample
        if self._answers_before < 0 or control is None or sample is None:
            return
        ending = self.trouble(now_ns, self.until_ns) or self.astray(sample) or self._stuck(sample)
        ended = control.heartbeat_answers > self._answers_before + 1 and not control.running
        over = ending is None and ended and self.limb.still > 2
        if over and self.off(sample) > _NEAR:
            ending = self.limb.fault_error("its move ended before it was there")
        if over or ending is not None:
            self.exchange.release(self, ending)

    def _stuck(self, sample: Sample) -> TradeError | None:
        """Returns the fault for measurements without any change: the arm is blocked or paused, or values are old."""
        if sample.positions != self._place or not self._moved_ns:
            self._place, self._moved_ns = sample.positions, sample.at_ns
        return self.limb.lag_error("it makes no progress") if sample.at_ns - self._moved_ns > _STUCK_NS else None


class LineMove(Move):
    """A move of the tool along a line, to a goal."""

    def order(self, number: int) -> MoveLine:
        accel = self.limb.arm.max_accel_m_s2
        return MoveLine(number=number, expires_ns=self.expires_ns, pose=self.goal, speed=self.speed, accel=accel)

    def off(self, sample: Sample) -> float:
        return max(abs(a - b) for a, b in zip(sample.pose[:3], self.goal[:3], strict=True))

    def beginning(self) -> Steps:
        yield from super().beginning()
        sample = self.usable()
        near, poses = sample.positions, poses_on(sample.pose, self.goal)
        for pose in poses:
            done = yield from self.exchange.carrying_out(
                self,
                lambda number, pose=pose, near=near: Solve(
                    number=number, expires_ns=self.expires_ns, pose=pose, near=near
                ),
            )
            if not done.angles:
                problem = f"the line leads out of reach: there are no joint angles for {pose}"
                raise InvalidArgument(service=self.service, argument="pose", problem=problem)
            self._check_range(near, done.angles)
            near = done.angles

    def _check_range(self, before: Sequence[float], angles: Sequence[float]) -> None:
        arm = self.limb.arm
        spans = zip(self.limb.joints, before, angles, arm.min_rad, arm.max_rad, strict=True)
        for name, was, angle, low, high in spans:
            if (angle > high and angle > was) or (angle < low and angle < was):
                raise LimitExceeded(what=f"{name} on the line", value=angle, lower=low, upper=high, unit="rad")


class SetPoint(Motion):
    """Angles that are valid for a short time; if they are not renewed, the arm stops.

    Each renewal is a set-point of its own, with its own permit, which replaces the previous one and continues from the
    current position of the stream.
    """

    streams = True

    def __init__(
        self,
        exchange: Exchange,
        goal: Sequence[float],
        terms: Terms,
        valid_ns: int,
    ) -> None:
        super().__init__(exchange, terms)
        self._goal = list(goal)
        self._until_ns = exchange.clock() + valid_ns
        self._valid_ns = valid_ns
        self._chase: SetpointFilter | None = None
        self._sent_ns = 0

    def steps(self) -> Steps:
        before = self.limb.motion
        if isinstance(before, SetPoint) and before._chase is not None and self.exchange.taken:
            self.usable()
            self._chase, self._sent_ns = before._chase, before._sent_ns
        else:
            yield from self.beginning()
            arm = self.limb.arm
            self._chase = SetpointFilter(self.usable().positions, arm.max_speed_rad_s, arm.max_accel_rad_s2)
            self._sent_ns = self.exchange.clock() - self.exchange.period_ns
            self._until_ns = self.exchange.clock() + self._valid_ns  # control had to be taken first
        self.gate()
        self.exchange.take_over(self)
        self.expires_ns = self._until_ns  # once sent, it is valid for its own time
        self._send(self.exchange.clock())
        self.finish()

    def watch(self, now_ns: int) -> None:
        """Ends the set-point for each reason that would prevent sending it: expiry, stop, lock, fault, no answer."""
        try:
            self._send(now_ns)
        except TradeError as ending:
            self.exchange.release(self, ending)

    def _send(self, now_ns: int) -> None:
        self.gate()
        if (ending := self.trouble(now_ns, None) or self.astray(self.usable())) is not None:
            raise ending
        if self._chase is not None and now_ns - self._sent_ns >= self.exchange.period_ns // 2:
            dt = min(now_ns - self._sent_ns, 5 * self.exchange.period_ns) / 1e9
            self._sent_ns = now_ns
            self.exchange.stream(self._chase.step(self._goal, dt))


class Follow(Motion):
    """A trajectory: each cycle sends the set-point due, and compares each joint with it."""

    streams = True

    def __init__(
        self,
        exchange: Exchange,
        plan: Plan,
        terms: Terms,
    ) -> None:
        super().__init__(exchange, terms)
        self._plan = plan
        self._sent_ns = 0

    def steps(self) -> Steps:
        yield from self.beginning()
        self._compare(self.usable(), "start", self._plan.tolerances.start_rad)
        self.gate()
        self.exchange.take_over(self)
        self.expires_ns = _NO_DEADLINE_NS  # it started in time; its duration is checked separately
        self._sent_ns = self.exchange.clock()
        self._plan.course.ready(self._sent_ns)

    def watch(self, now_ns: int) -> None:
        if not self._sent_ns:
            return
        try:
            self.gate()
            self._go_on(now_ns)
        except TradeError as ending:
            self._plan.course.fail(ending)
            self.exchange.release(self, ending)

    def _go_on(self, now_ns: int) -> None:
        if (ending := self.trouble(now_ns, self.until_ns)) is not None:
            raise ending
        if now_ns - self._sent_ns > _HELD_UP_NS:
            raise MotionStopped(device=self.limb.name, reason="its bus was held up: it got no set-points")
        course, tolerances, sample = self._plan.course, self._plan.tolerances, self.usable()
        if course.failed is not None:
            raise MotionStopped(device=self.limb.name, reason=f"its group could not go on: {course.failed}")
        if (astray := self.astray(sample)) is not None:
            raise astray
        self._compare(sample, "path", tolerances.path_rad)
        late_s = course.elapsed_s(now_ns) - course.duration_s
        if late_s >= 0 and self.limb.still > 2:
            self._compare(sample, "goal", tolerances.goal_rad)
            self.exchange.release(self, None)
            return
        if late_s > tolerances.goal_time_s:
            raise self.limb.lag_error("it does not come to rest at the end of its trajectory")
        self.exchange.stream([track.curve.at(course.elapsed_s(now_ns))[0] for track in self._plan.tracks])
        self._sent_ns = now_ns

    def _compare(self, sample: Sample, what: TrajectoryPart, tolerance_rad: float) -> None:
        elapsed_s = self._plan.course.elapsed_s(sample.at_ns)
        for name, angle, track in zip(self.limb.joints, sample.positions, self._plan.tracks, strict=True):
            error = angle - track.curve.at(elapsed_s)[0]
            self._plan.course.note(track.limits.name, error)
            if abs(error) > tolerance_rad:
                raise ToleranceExceeded(
                    device=name,
                    bus=self.limb.bus,
                    what=what,
                    error_rad=error,
                    tolerance_rad=tolerance_rad,
                    cause=self.limb.slowed,
                )
