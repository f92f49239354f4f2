"""Moves to goals: checked immediately before they are sent, and watched until they are at rest or ended."""

from collections.abc import Sequence
from typing import Final

from msgspec import Struct

from trade.errors import TradeError
from trade_drivers.bus._gate import Terms
from trade_drivers.joints._axis import AxisT, Goal
from trade_drivers.joints._cycle import Exchange, Motion
from trade_drivers.joints._profile import Leg, together

_SETTLING_S: Final = 0.15
_STUCK_S: Final = 0.5
_MOST_PER_CYCLE_S: Final = 0.1


class _Progress(Struct):
    """The progress of one joint's move."""

    goal: int
    closest: int
    measured_ns: int
    """The time of the last check."""
    watched_s: float = 0.0
    """How long the joint has been measured; time without measurements does not count."""
    waiting_s: float = 0.0
    """How long the joint has made no progress."""


class Move(Motion[AxisT]):
    """A move of one or more joints to goals in counts."""

    def __init__(
        self,
        exchange: Exchange[AxisT],
        axes: Sequence[AxisT],
        goals: Sequence[int],
        speeds: Sequence[int],
        terms: Terms,
    ) -> None:
        super().__init__(exchange, axes, terms)
        self._goals = dict(zip(axes, goals, strict=True))
        self._speeds = tuple(speeds)
        self._progress: dict[AxisT, _Progress] = {}
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
            Leg(distance, speed, axis.accel_counts, axis.resolution)
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
        self._patience_s = 1.0 + 2 * max(profile.duration_s for profile in profiles)

    def watch(self, now_ns: int) -> None:
        ending = self.trouble(now_ns, self.until_ns)
        if ending is None:
            away = [axis for axis in self.devices if not self._arrived(axis)]
            if not away:
                self.final_counts = tuple(axis.sample.position for axis in self.devices if axis.sample is not None)
                self.exchange.release(self, None)
                return
            ending = self._stuck(away)
        if ending is not None:
            self.exchange.release(self, ending)

    def _arrived(self, axis: AxisT) -> bool:
        progress, sample = self._progress[axis], axis.sample
        if sample is None:
            return False
        elapsed_s = min(max(0, sample.at_ns - progress.measured_ns) / 1e9, _MOST_PER_CYCLE_S)
        progress.measured_ns = max(sample.at_ns, progress.measured_ns)
        progress.watched_s += elapsed_s
        distance = abs(progress.goal - sample.position)
        if distance < progress.closest:
            progress.closest, progress.waiting_s = distance, 0.0
        else:
            progress.waiting_s += elapsed_s
        if axis.still < 2:
            return False
        return distance <= axis.resolution.arrived or (
            distance <= axis.resolution.near and progress.waiting_s > _SETTLING_S
        )

    def _stuck(self, away: Sequence[AxisT]) -> TradeError | None:
        """Returns the fault of a joint that was measured without progress towards its goal, of those not there yet."""
        for axis in away:
            progress = self._progress[axis]
            late = progress.watched_s > self._patience_s
            blocked = progress.closest > axis.resolution.near and progress.waiting_s > _STUCK_S
            if late or blocked:
                short_rad = progress.closest * axis.resolution.rad
                fault = f"it makes no progress, {short_rad:.3g} rad short of its goal, as if blocked"
                if blocked:  # blocked: latched, so that it does not move until a client enables it
                    axis.fault, axis.ready = fault, False
                return axis.fault_error(fault)
        return None
