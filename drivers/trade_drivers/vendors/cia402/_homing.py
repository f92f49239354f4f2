"""Homing of a drive: only on request, watched like any motion."""

from typing import TYPE_CHECKING, Final

from trade.errors import TradeError
from trade_drivers.bus._gate import Terms
from trade_drivers.joints import Motion, Steps
from trade_drivers.vendors.cia402 import _jobs as jobs
from trade_drivers.vendors.cia402 import _machine as machine
from trade_drivers.vendors.cia402 import _table as table
from trade_drivers.vendors.cia402._axis import DriveAxis

if TYPE_CHECKING:
    from trade_drivers.vendors.cia402._cycle import DriveExchange

_LONGEST_NS: Final = 30_000_000_000


class Homing(Motion[DriveAxis]):
    """A search by the drive itself for its zero; afterwards it must be enabled again in its usual mode."""

    def __init__(
        self,
        exchange: "DriveExchange",
        axis: DriveAxis,
        terms: Terms,
        *,
        method: int,
        speed_counts: int,
    ) -> None:
        super().__init__(exchange, [axis], terms)
        self._bus, self._axis = exchange, axis
        self._method, self._speed = method, speed_counts
        self._began_ns = 0

    def steps(self) -> Steps:
        axis = self._axis
        if not axis.zero.in_doubt:  # otherwise this is the remedy
            axis.check_usable(self.exchange.clock(), self.exchange.stale_after_ns)
        axis.zero.searching = True
        yield from jobs.resting(self._bus, self, axis)
        if not axis.ready or axis.stream is not None:
            yield from self.exchange.enabling(self, axis)
        for entry, value in (
            (table.HOMING_METHOD, self._method),
            (table.HOMING_SPEEDS[0], self._speed),
            (table.HOMING_SPEEDS[1], max(1, self._speed // 4)),
            (table.HOMING_ACCELERATION, axis.accel_counts),
        ):
            yield from jobs.write(self._bus, self, axis, entry, value)
        axis.ready, axis.entered = False, 0  # whatever the outcome, it has left its usual mode
        yield from jobs.set_mode(self._bus, self, axis, table.HOMING)
        self.launch()

    def launch(self) -> None:
        self.gate()
        self._bus.command(self._axis, machine.OPERATE | machine.NEW_SET_POINT)
        self.exchange.take_over(self)
        self._began_ns = self.exchange.clock()

    def finish(self, error: TradeError | None = None) -> None:
        if not self.ended and self._axis.zero.searching:
            self._axis.zero.searched(found=error is None)
        super().finish(error)

    def goal_of(self, axis: DriveAxis) -> int:
        return axis.sample.position if axis.sample is not None else 0

    def watch(self, now_ns: int) -> None:
        ending = self.trouble(now_ns, None) or self._trouble(now_ns)
        if ending is not None or self._found():
            self._bus.command(self._axis, machine.HOLD)
            self.exchange.release(self, ending)

    def _found(self) -> bool:
        """Returns whether it reports the end of this search."""
        sample, settled_ns = self._axis.sample, self._began_ns + 2 * self.exchange.period_ns
        if sample is None or sample.at_ns <= settled_ns:
            return False
        return self._axis.statusword & machine.HOMING_STATUS == machine.HOMING_DONE

    def _trouble(self, now_ns: int) -> TradeError | None:
        axis = self._axis
        if axis.statusword & machine.HOMING_ERROR:
            return axis.fault_error("it has not found its home (statusword bit 13)")
        if now_ns >= min(self.until_ns or now_ns + 1, self._began_ns + _LONGEST_NS):
            return axis.fault_error("it has not found its home in time")
        return None
