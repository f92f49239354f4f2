"""A set-point: goals that hold for a short while only; not renewed in time, the joints ramp to a stop."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from trade.errors import TradeError
from trade_drivers.bus._deadlines import Terms
from trade_drivers.joints._axis import AxisT, Goal
from trade_drivers.joints._jobs import Manner
from trade_drivers.joints._motion import Motion

if TYPE_CHECKING:
    from trade_drivers.joints._cycle import Exchange

__all__ = ["SetPoint"]


class SetPoint(Motion[AxisT]):
    """Goals in counts and the speed to go there; whoever waits for it is let go as soon as it is on the wire.

    Each renewal is a set-point of its own, admitted anew, that takes over from the one before.
    """

    def __init__(
        self,
        exchange: "Exchange[AxisT]",
        axes: Sequence[AxisT],
        goals: Sequence[int],
        speeds: Sequence[int],
        terms: Terms,
        until_ns: int,
        manner: Manner = Manner.GOALS,
    ) -> None:
        super().__init__(exchange, axes, terms._replace(expires_ns=min(terms.expires_ns, until_ns)))
        self._goals = dict(zip(axes, goals, strict=True))
        self._speeds = dict(zip(axes, speeds, strict=True))
        self._until_ns = until_ns
        self.manner = manner

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
        self.expires_ns = self._until_ns  # on its way, it lasts as long as it was said to
        self.finish()

    def watch(self, now_ns: int) -> None:
        """What would keep it off the wire ends it, too: its time, a stop, a lock, a fault, silence."""
        try:
            self.gate()
            if ending := self.trouble(now_ns, None):
                raise ending
        except TradeError as ending:
            self.exchange.release(self, ending)
