"""A move: checked and released at the wire, watched until at rest, ended by whatever comes first."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from msgspec import Struct

from trade.errors import MotionStopped, TradeError
from trade_drivers.bus._deadlines import Terms
from trade_drivers.bus._jobs import Command, Steps
from trade_drivers.joints._axis import AxisT, Goal
from trade_drivers.joints._jobs import Manner
from trade_drivers.joints._profile import Leg, together

if TYPE_CHECKING:
    from trade_drivers.joints._cycle import Exchange

__all__ = ["Motion", "Move"]

_SETTLING_S: Final = 0.15
_STUCK_S: Final = 0.5
_MOST_PER_CYCLE_S: Final = 0.1


class _Progress(Struct):
    """How one joint's move is coming along."""

    goal: int
    closest: int
    measured_ns: int
    """When it was last looked at."""
    waiting_s: float = 0.0
    """How long it was seen not to come closer."""


class Motion(Command[AxisT, "Exchange[AxisT]"]):
    """What sets joints moving, and is watched until something ends it."""

    manner = Manner.GOALS
    attended_ns = 0
    """When it was last looked after, by the lasting clock."""

    def steps(self) -> Steps:
        """Enable what is relaxed, then launch."""
        exchange = self.exchange
        for axis in self.devices:
            axis.check_usable(exchange.clock(), exchange.stale_after_ns)
        for axis in self.devices:
            if not axis.ready:
                yield from exchange.enabling(self, axis)
        yield from exchange.making_way(self)
        self.launch()

    def launch(self) -> None:
        """Write all goals in one packet, and take the joints over."""
        raise NotImplementedError

    def goal_of(self, axis: AxisT) -> int:
        """Where one of its joints is going, in counts."""
        raise NotImplementedError

    def watch(self, now_ns: int) -> None:
        """Look at the newest measurements; end it if it is over or must not go on."""
        raise NotImplementedError

    def trouble(self, now_ns: int, until_ns: int | None) -> TradeError | None:
        """Why none of its joints may go on: a driver that was held up, a fault, silence, or the end of its call."""
        attended_ns, self.attended_ns = self.attended_ns, self.exchange.lasting_clock()
        if held_up := self.exchange.held_up(attended_ns):
            axis = next((axis for axis in self.devices if axis.fault), self.devices[0])
            return axis.faulty(f"{axis.fault}; {held_up}" if axis.fault else held_up)
        for axis in self.devices:
            if axis.fault:
                return axis.faulty()
            if axis.silent or axis.age_ns(now_ns) > self.exchange.stale_after_ns:
                return axis.deaf(now_ns)
        if until_ns is not None and now_ns >= until_ns:
            return MotionStopped(
                device=self.devices[0].name, reason="the deadline of its call came; give it a longer one"
            )
        return None

    def done_stepping(self) -> None:
        """Launched; now it is watched. (It has ended already if anything was refused.)"""


class Move(Motion[AxisT]):
    """A move of one or more joints to goals in counts."""

    def __init__(
        self,
        exchange: "Exchange[AxisT]",
        axes: Sequence[AxisT],
        goals: Sequence[int],
        speeds: Sequence[int],
        terms: Terms,
    ) -> None:
        super().__init__(exchange, axes, terms)
        self._goals = dict(zip(axes, goals, strict=True))
        self._speeds = tuple(speeds)
        self._progress: dict[AxisT, _Progress] = {}
        self._began_ns = 0
        self._patience_s = 0.0
        self.final_counts: tuple[int, ...] = ()

    def goal_of(self, axis: AxisT) -> int:
        return self._goals[axis]

    def launch(self) -> None:
        exchange, now_ns = self.exchange, self.exchange.clock()
        samples = [axis.check_usable(now_ns, exchange.stale_after_ns) for axis in self.devices]
        distances = [
            abs(self._goals[axis] - sample.position) for axis, sample in zip(self.devices, samples, strict=True)
        ]
        legs = [
            Leg(distance, speed, axis.accel_counts, axis.grain)
            for axis, distance, speed in zip(self.devices, distances, self._speeds, strict=True)
        ]
        profiles = together(legs)
        goals: dict[AxisT, Goal] = {}
        for axis, profile in zip(self.devices, profiles, strict=True):
            axis.check_goal(self._goals[axis])
            goals[axis] = Goal(self._goals[axis], profile.accel_counts, profile.speed_counts)
        exchange.write_goals(goals, self.gate)
        exchange.take_over(self)
        self._progress = {
            axis: _Progress(self._goals[axis], distance, now_ns)
            for axis, distance in zip(self.devices, distances, strict=True)
        }
        self._began_ns = now_ns
        self._patience_s = 1.0 + 2 * max(profile.duration_s for profile in profiles)

    def watch(self, now_ns: int) -> None:
        ending = self.trouble(now_ns, self.until_ns)
        if ending is None:
            arrived = [self._arrived(axis) for axis in self.devices]
            if all(arrived):
                self.final_counts = tuple(axis.sample.position for axis in self.devices if axis.sample is not None)
                self.exchange.release(self, None)
                return
            ending = self._stuck()
        if ending is not None:
            self.exchange.release(self, ending)

    def _arrived(self, axis: AxisT) -> bool:
        progress, sample = self._progress[axis], axis.sample
        if sample is None:
            return False
        elapsed_s = min(max(0, sample.at_ns - progress.measured_ns) / 1e9, _MOST_PER_CYCLE_S)
        progress.measured_ns = max(sample.at_ns, progress.measured_ns)
        distance = abs(progress.goal - sample.position)
        if distance < progress.closest:
            progress.closest, progress.waiting_s = distance, 0.0
        else:
            progress.waiting_s += elapsed_s
        if axis.still < 2:
            return False
        return distance <= axis.grain.arrived or (distance <= axis.grain.near and progress.waiting_s > _SETTLING_S)

    def _stuck(self) -> TradeError | None:
        """Why it does not arrive, as far as that was measured: silence is another matter."""
        for axis, progress in self._progress.items():
            late = (progress.measured_ns - self._began_ns) / 1e9 > self._patience_s
            blocked = progress.closest > axis.grain.near and progress.waiting_s > _STUCK_S
            if late or blocked:
                short_rad = progress.closest * axis.grain.rad
                fault = f"it makes no progress, {short_rad:.3g} rad short of its goal, as if blocked"
                if blocked:  # it stands: nothing moves it until somebody has looked
                    axis.fault, axis.ready = fault, False
                return axis.faulty(fault)
        return None
