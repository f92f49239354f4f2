"""Set-points: goals that are valid for a short time; if they are not renewed, the joints ramp to a stop."""

from collections.abc import Sequence

from trade.errors import TradeError
from trade_drivers.bus._gate import Terms
from trade_drivers.joints._axis import AxisT, Goal
from trade_drivers.joints._cycle import ControlMode, Exchange, Motion


class SetPoint(Motion[AxisT]):
    """Goals in counts and the speed to reach them; the service returns as soon as they are sent.

    Each renewal is a set-point of its own, with its own permit, and replaces the previous one.
    """

    def __init__(
        self,
        exchange: Exchange[AxisT],
        axes: Sequence[AxisT],
        goals: Sequence[int],
        speeds: Sequence[int],
        terms: Terms,
        until_ns: int,
        control_mode: ControlMode = ControlMode.GOALS,
    ) -> None:
        super().__init__(exchange, axes, terms._replace(expires_ns=min(terms.expires_ns, until_ns)))
        self._goals = dict(zip(axes, goals, strict=True))
        self._speeds = dict(zip(axes, speeds, strict=True))
        self._until_ns = until_ns
        self.control_mode = control_mode

    def goal_of(self, axis: AxisT) -> int:
        return self._goals[axis]

    def launch(self) -> None:
        now_ns = self.exchange.clock()
        goals: dict[AxisT, Goal] = {}
        for axis in self.devices:
            axis.check_usable(now_ns, self.exchange.stale_after_ns)
            axis.check_goal(self._goals[axis])
            goals[axis] = Goal(self._goals[axis], axis.accel_counts, self._speeds[axis])
        self.exchange.write_goals(goals, self.gate)
        self.exchange.take_over(self)
        self.expires_ns = self._until_ns  # once sent, it is valid for its own time
        self.finish()

    def watch(self, now_ns: int) -> None:
        """Ends the set-point for each reason that would prevent sending it: expiry, stop, lock, fault, no answer."""
        try:
            self.gate()
            if ending := self.trouble(now_ns, None):
                raise ending
        except TradeError as ending:
            self.exchange.release(self, ending)
