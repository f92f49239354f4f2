"""The cyclic exchange with the joints of one bus, whoever built them: stops, work, motions, holding."""

from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress

from trade.errors import MotionStopped, TradeError
from trade_drivers.bus._cycle import HALT_NS, BusCycle, StopTicket
from trade_drivers.bus._jobs import Device, Gate, Steps, Work
from trade_drivers.joints._axis import AxisT, Goal
from trade_drivers.joints._jobs import Leave
from trade_drivers.joints._motion import Motion

__all__ = ["Exchange"]


class Exchange(BusCycle[AxisT]):
    """What happens on one bus of joints. ``stop`` is for any thread, too."""

    # --- what a device of this kind is told, and how

    @abstractmethod
    def write_goals(self, goals: Mapping[AxisT, Goal], gate: Gate) -> None:
        """Send joints on their way, all of them or none; the gate is asked right before the bytes go out."""

    @abstractmethod
    def write_positions(self, positions: Mapping[AxisT, int], gate: Gate) -> None:
        """The same for joints on their way, as fast as they are already; only if they ``can_take_goals``."""

    def cycles_a_goal(self, axes: Sequence[AxisT]) -> int:  # noqa: ARG002 - most devices take one in each
        """How many cycles it takes at most until these joints can take the next position of a trajectory."""
        return 1

    def reached_ns(self, axes: Sequence[AxisT]) -> int | None:  # noqa: ARG002 - as above
        """When joints that go from position to position are at one that is written now.

        None for joints that brake by themselves for each: theirs is to be where they would come to rest.
        """
        return None

    def can_take_goals(self, axes: Sequence[AxisT]) -> bool:  # noqa: ARG002 - most devices take a goal at any time
        """Whether these joints can take new goals now, and nothing else is about to give them some."""
        return True

    @abstractmethod
    def write_holds(self, positions: Mapping[AxisT, int]) -> None:
        """Have joints brake as hard as they may and hold, near these positions. Never waits."""

    @abstractmethod
    def enabling(self, job: Work[AxisT], axis: AxisT) -> Steps:
        """Torque on where the joint is measured to be, watchdog armed, all of it read back; then it is ``ready``."""

    @abstractmethod
    def relaxing(self, job: Work[AxisT], axis: AxisT) -> Steps:
        """Torque off, watchdog disarmed."""

    @abstractmethod
    def looking(self, axis: AxisT) -> Steps:
        """How the joint is, asked now."""

    def making_way(self, job: Motion[AxisT]) -> Steps:  # noqa: ARG002 - as above
        """Wait until its joints can take what it will tell them; ends what moves them, if that must rest first."""
        yield from ()

    @abstractmethod
    def leaving(self, job: Work[AxisT], axis: AxisT, *, relax: bool) -> Steps:
        """Torque off or left on, watchdog disarmed where it may be."""

    # --- from any thread

    def stop(self, axes: Sequence[AxisT], reason: str = "") -> StopTicket[AxisT]:
        """Void what was admitted for these joints, and have them hold before anything else happens on the bus."""
        reason = reason or self.why(axes)
        return self.order_stop(axes, reason, lambda: self.halt(axes, reason))

    def leave(self, alive: Callable[[], bool], *, relax: bool) -> None:
        if not self.devices:
            return
        with suppress(TradeError):  # a joint that cannot be heard keeps its watchdog; the others are left properly
            self.stop(self.devices, "its driver is leaving").wait(alive)
        leave = Leave(self, self.devices, relax=relax)
        self.submit(leave)
        leave.wait(alive)

    # --- from the bus thread

    def halt(self, axes: Iterable[AxisT], reason: str) -> None:
        """End the motions of these joints, whole groups, and have all of them hold where they are."""
        held = dict.fromkeys(axes)
        for axis in tuple(held):
            if (motion := axis.motion) is not None:
                held.update(dict.fromkeys(motion.devices))
        now_ns = self.clock()
        try:
            self.hold([axis for axis in held if not self._at_rest(axis, now_ns)], now_ns)
        finally:
            for axis in held:
                if axis.motion is not None:
                    self._forget(axis.motion, MotionStopped(device=axis.name, reason=reason))

    def halt_all(self, reason: str) -> None:
        self.halt(self.devices, reason)

    def _at_rest(self, axis: AxisT, now_ns: int) -> bool:
        """Nothing to stop: no torque, or no motion of ours and seen not to move."""
        idle = axis.motion is None and axis.still >= 2 and axis.age_ns(now_ns) <= self.stale_after_ns
        return idle or not axis.may_hold_torque

    def end_motion(self, axis: AxisT, reason: str) -> None:
        """End the motion of a joint that is being relaxed; the other members of its group hold."""
        if (motion := axis.motion) is not None:
            self.halt(motion.devices, reason)

    def release(self, motion: Motion[AxisT], error: TradeError | None) -> None:
        """A watched motion has ended: well, or with an error and all its joints held."""
        try:
            if error is not None:
                self.hold([axis for axis in motion.devices if axis.may_hold_torque], self.clock())
            else:
                motion.note("at rest")
        finally:
            self._forget(motion, error)

    def take_over(self, motion: Motion[AxisT]) -> None:
        """A motion's goals are out: those it replaces have ended, and what they left behind holds."""
        motion.note("wrote goal")
        motion.attended_ns = self.lasting_clock()
        replaced = dict.fromkeys(axis.motion for axis in motion.devices if axis.motion is not None)
        for axis in motion.devices:
            axis.motion, axis.still, axis.halting_since_ns = motion, 0, 0
            axis.tell_moving()
        for old in replaced:
            left = [axis for axis in old.devices if axis.motion is old]
            self._forget(old, MotionStopped(device=motion.devices[0].name, reason="another move took over"))
            self.hold(left, self.clock())

    def fail_motion(self, device: AxisT, error_of: Callable[[Device], TradeError]) -> None:
        if device.motion is not None:
            self._forget(device.motion, error_of(device))

    def require_answering(self, axis: AxisT) -> None:
        """Raises ``DeviceSilent`` for a joint that is left out because it does not answer."""
        if axis.silent:
            raise axis.deaf(self.clock())

    # --- parts of a cycle

    def watch(self) -> None:
        """Look at motions and stops with what was measured, and end what is over."""
        now_ns = self.clock()
        for motion in dict.fromkeys(axis.motion for axis in self.devices if axis.motion is not None):
            motion.watch(now_ns)
        again: list[AxisT] = []
        for axis in self.devices:
            if axis.halting_since_ns:
                self._watch_halt(axis, now_ns, again)
        self.hold(again, now_ns)
        for axis in self.devices:
            axis.tell_moving()
        self.answer_stops(now_ns)

    def _watch_halt(self, axis: AxisT, now_ns: int, again: list[AxisT]) -> None:
        """A fault says nothing of its having stopped; but who has one is told nothing more.

        Of who is silent nobody sees the rest: a stop says so, and who is back is not told to hold by an old one.
        """
        if axis.still >= 2 or not axis.may_hold_torque or axis.silent:
            axis.halting_since_ns = 0
        elif not axis.fault and now_ns - axis.halting_since_ns <= HALT_NS and axis.moved_since_held:
            again.append(axis)  # it was still on its way: so it need not come back as far

    def hold(self, axes: Sequence[AxisT], now_ns: int) -> None:
        """Have joints hold, and watch them until they are at rest."""
        positions: dict[AxisT, int] = {}
        for axis in axes:
            axis.held_counts = axis.hold_counts(now_ns, self.watchdog_ns)
            if axis.held_counts is not None:
                positions[axis] = axis.held_counts
            axis.still, axis.held_ns = 0, now_ns
            axis.halting_since_ns = axis.halting_since_ns or now_ns
        if positions:
            self.write_holds(positions)

    def _forget(self, motion: Motion[AxisT], error: TradeError | None) -> None:
        for axis in motion.devices:
            if axis.motion is motion:
                axis.motion = None
                axis.tell_moving()
        motion.finish(error)
