"""The cyclic exchange with the joints of one bus: stops, work, motions, holding; and the base of its motions."""

from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from enum import Enum
from typing import Final

from trade.errors import DeviceSilent, MotionStopped, TradeError
from trade_drivers.bus._angle_store import Span
from trade_drivers.bus._cycle import HALT_NS, BusCycle, StopTicket
from trade_drivers.bus._gate import Command
from trade_drivers.bus._jobs import AwaitedJob, Device, Gate, Steps
from trade_drivers.joints._axis import AxisMotion, AxisT, Goal
from trade_robotfile import Bus

_SAVE_AGAIN_NS: Final = 1_000_000_000
"""The pause before what could not be saved is saved again."""


class ControlMode(Enum):
    """The kind of a motion's commands, for devices with a mode for each."""

    GOALS = "goals"
    """A goal to move to."""
    POSITIONS = "positions"
    """A position in each cycle."""
    SPEEDS = "speeds"
    """A velocity, and the position where it must end."""


class Exchange(BusCycle[AxisT]):
    """The exchange with the joints of one bus. Any thread may also call ``stop``."""

    def __init__(self, bus: Bus, devices: Sequence[AxisT], clock: Callable[[], int] | None = None) -> None:
        super().__init__(bus, devices, clock)
        self.save_angles: Callable[[Mapping[str, Span]], Future[bool]] | None = None
        """Saves where joints are, by their names in the robot file, without waiting; says whether it succeeded."""
        self._unsaved = False
        """Whether saving has failed, as on a full disk, since all was saved again."""
        self._save_again_ns = 0
        for axis in devices:
            axis.zero.period_s = 1 / bus.rate_hz
            axis.zero.unled_s = bus.watchdog_s + bus.stale_after_s

    # --- commands, which depend on the kind of device

    @abstractmethod
    def write_goals(self, goals: Mapping[AxisT, Goal], gate: Gate) -> None:
        """Sends goals to all joints or none; the gate is called immediately before the bytes are sent."""

    @abstractmethod
    def write_positions(self, positions: Mapping[AxisT, int], gate: Gate) -> None:
        """Sends new goals to moving joints at an unchanged speed; only if they ``can_take_goals``."""

    def cycles_a_goal(self, axes: Sequence[AxisT]) -> int:  # noqa: ARG002 - most devices accept one in each
        """Returns the maximum number of cycles between two positions of a trajectory for these joints."""
        return 1

    def reached_ns(self, axes: Sequence[AxisT]) -> int | None:  # noqa: ARG002 - as above
        """Returns when joints that interpolate between positions reach one that is written now.

        None for joints that brake for each goal by themselves; their goal is the point where they would come to rest.
        """
        return None

    def can_take_goals(self, axes: Sequence[AxisT]) -> bool:  # noqa: ARG002 - most devices accept goals at any time
        """Returns whether these joints can accept new goals now, and no other motion is about to send any."""
        return True

    @abstractmethod
    def write_holds(self, positions: Mapping[AxisT, int]) -> None:
        """Makes joints brake at their maximum deceleration and hold near these positions. Never waits."""

    @abstractmethod
    def enabling(self, job: AwaitedJob[AxisT], axis: AxisT) -> Steps:
        """Arms the watchdog and switches torque on at the measured position, reads both back, and sets ``ready``."""

    @abstractmethod
    def relaxing(self, job: AwaitedJob[AxisT], axis: AxisT) -> Steps:
        """Switches torque off and disarms the watchdog."""

    @abstractmethod
    def looking(self, axis: AxisT) -> Steps:
        """Reads the joint's health now."""

    def making_way(self, job: "Motion[AxisT]") -> Steps:  # noqa: ARG002 - as above
        """Waits until the joints can accept the commands; ends their current motion if they must be at rest."""
        yield from ()

    @abstractmethod
    def leaving(self, job: AwaitedJob[AxisT], axis: AxisT, *, relax: bool) -> Steps:
        """Switches torque off or leaves it on, and disarms the watchdog where that is allowed."""

    # --- from any thread

    def stop(self, axes: Sequence[AxisT], reason: str = "") -> StopTicket[AxisT]:
        """Voids all permits for these joints, and makes them hold before anything else happens on the bus."""
        reason = reason or self.why(axes)
        return self.order_stop(axes, reason, lambda: self.halt(axes, reason))

    def leave(self, alive: Callable[[], bool], *, relax: bool) -> None:
        if not self.devices:
            return
        with suppress(TradeError):  # an offline joint keeps its watchdog; the others are left properly
            self.stop(self.devices, "its driver is leaving").wait(alive)
        leave = Leave(self, self.devices, relax=relax)
        self.submit(leave)
        leave.wait(alive)

    # --- from the bus thread

    def halt(self, axes: Iterable[AxisT], reason: str) -> None:
        """Ends the motions of these joints and their groups, and makes all of them hold where they are."""
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
        """Returns whether there is nothing to stop: no torque, or no commanded motion and measured at rest."""
        idle = axis.motion is None and axis.still >= 2 and axis.age_ns(now_ns) <= self.stale_after_ns
        return idle or not axis.may_hold_torque

    def end_motion(self, axis: AxisT, reason: str) -> None:
        """Ends the motion of a joint that is being relaxed; the other members of its group hold."""
        if (motion := axis.motion) is not None:
            self.halt(motion.devices, reason)

    def release(self, motion: AxisMotion[AxisT], error: TradeError | None) -> None:
        """Completes a watched motion: successfully, or with an error and all its joints holding."""
        try:
            if error is not None:
                self.hold([axis for axis in motion.devices if axis.may_hold_torque], self.clock())
            else:
                motion.note("at rest")
        finally:
            self._forget(motion, error)

    def take_over(self, motion: "Motion[AxisT]") -> None:
        """Starts to watch a motion after its goals are sent; ends the motions it replaces, whose other joints hold."""
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
        """Raises ``DeviceSilent`` for a joint that is left out of the cycles because it does not answer."""
        if axis.silent:
            raise axis.silent_error(self.clock())

    # --- parts of a cycle

    def watch(self) -> None:
        """Checks motions and stops against the new measurements, and completes those that are over."""
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
        self._save_angles(now_ns)

    def _save_angles(self, now_ns: int) -> None:
        if self.save_angles is not None:
            if self._unsaved and now_ns >= self._save_again_ns:
                self._unsaved, self._save_again_ns = False, now_ns + _SAVE_AGAIN_NS
                for axis in self.devices:
                    axis.zero.unsaved()
            changed = {axis.joint.name: span for axis in self.devices if (span := axis.zero.to_save()) is not None}
            if changed:
                self.save_angles(changed).add_done_callback(self._saved)

    def _saved(self, saving: Future[bool]) -> None:
        """Called on the thread of the disk."""
        if not saving.result():
            self._unsaved = True

    def _watch_halt(self, axis: AxisT, now_ns: int, again: list[AxisT]) -> None:
        """Repeats the hold of a joint that still moves, unless it has a fault; a fault does not prove that it stopped.

        An offline joint cannot be seen at rest: its stop reports that, and it is not repeated when the joint is back.
        """
        if axis.still >= 2 or not axis.may_hold_torque or axis.silent:
            axis.halting_since_ns = 0
        elif not axis.fault and now_ns - axis.halting_since_ns <= HALT_NS and axis.moved_since_held:
            again.append(axis)  # still moving, so that it comes back a shorter way

    def hold(self, axes: Sequence[AxisT], now_ns: int) -> None:
        """Makes joints hold, and watches them until they are at rest."""
        positions: dict[AxisT, int] = {}
        for axis in axes:
            axis.held_counts = axis.hold_counts(now_ns, self.watchdog_ns)
            if axis.held_counts is not None:
                positions[axis] = axis.held_counts
            axis.still, axis.held_ns = 0, now_ns
            axis.halting_since_ns = axis.halting_since_ns or now_ns
        if positions:
            self.write_holds(positions)

    def _forget(self, motion: AxisMotion[AxisT], error: TradeError | None) -> None:
        for axis in motion.devices:
            if axis.motion is motion:
                axis.motion = None
                axis.tell_moving()
        motion.finish(error)


class Motion(AxisMotion[AxisT], Command[AxisT, Exchange[AxisT]]):
    """A command that moves joints, and is watched until it ends."""

    control_mode = ControlMode.GOALS
    attended_ns = 0
    """When it was last checked, by the lasting clock."""

    def steps(self) -> Steps:
        """Enables relaxed joints, then launches."""
        exchange = self.exchange
        for axis in self.devices:
            axis.check_usable(exchange.clock(), exchange.stale_after_ns)
        for axis in self.devices:
            if not axis.ready:
                yield from exchange.enabling(self, axis)
        yield from exchange.making_way(self)
        self.launch()

    def launch(self) -> None:
        """Writes all goals in one packet, and takes the joints over."""
        raise NotImplementedError

    def trouble(self, now_ns: int, until_ns: int | None) -> TradeError | None:
        """Returns why the motion must end: an interrupted driver, a fault, an offline joint, or the call's deadline."""
        attended_ns, self.attended_ns = self.attended_ns, self.exchange.lasting_clock()
        if held_up := self.exchange.held_up(attended_ns):
            axis = next((axis for axis in self.devices if axis.fault), self.devices[0])
            return axis.fault_error(f"{axis.fault}; {held_up}" if axis.fault else held_up)
        for axis in self.devices:
            if axis.fault:
                return axis.fault_error()
            if axis.silent or axis.age_ns(now_ns) > self.exchange.stale_after_ns:
                return axis.silent_error(now_ns)
        if until_ns is not None and now_ns >= until_ns:
            return MotionStopped(device=self.devices[0].name, reason="its call reached its deadline", late=True)
        return None

    def done_stepping(self) -> None:
        """Does nothing: the motion is watched until it ends. (It has already ended if it was refused.)"""


class Leave(AwaitedJob[AxisT]):
    """The shutdown of the driver after all joints were stopped: hold or relax, as the robot file says.

    The watchdog of a holding joint is disarmed after the joint was seen at rest, since the driver's silence is then
    intended and an expired watchdog would hinder the next driver. Otherwise it stays armed.
    """

    def __init__(self, exchange: Exchange[AxisT], axes: Sequence[AxisT], *, relax: bool) -> None:
        super().__init__(axes)
        self._exchange = exchange
        self._relax = relax

    def steps(self) -> Steps:
        for axis in self.devices:
            if axis.silent:
                continue
            try:
                yield from self._exchange.leaving(self, axis, relax=self._relax)
            except DeviceSilent:
                continue  # like a joint that was silent before: ``unseen()`` reports it
            except TradeError as problem:
                self.finish(problem)
