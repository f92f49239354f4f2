"""Homing of a drive, only on request, watched like any motion; and a motor with homing, which only drives support."""

from typing import Annotated, Final

from trade import Meta, service
from trade.errors import TradeError
from trade_drivers._validation import within
from trade_drivers.bus._gate import Terms, admitted, span
from trade_drivers.joints import BusMotor, Motion, Steps
from trade_drivers.vendors.cia402 import _table as table
from trade_drivers.vendors.cia402._axis import DriveAxis
from trade_drivers.vendors.cia402._exchange import DriveExchange

_LONGEST_NS: Final = 30_000_000_000

Method = Annotated[int, Meta(ge=-128, le=37, description="homing method of CiA 402-2; 37: the zero is here")]
Slow = Annotated[float, Meta(gt=0, description="speed of the search in rad/s; by default a tenth of the joint's limit")]


class Homing(Motion[DriveAxis]):
    """A search by the drive itself for its zero; afterwards it must be enabled again in its usual mode."""

    def __init__(
        self,
        exchange: DriveExchange,
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
        yield from self._bus.resting(self, axis)
        if not axis.ready or axis.stream is not None:
            yield from self.exchange.enabling(self, axis)
        for entry, value in (
            (table.HOMING_METHOD, self._method),
            (table.HOMING_SPEEDS[0], self._speed),
            (table.HOMING_SPEEDS[1], max(1, self._speed // 4)),
            (table.HOMING_ACCELERATION, axis.accel_counts),
        ):
            yield from self._bus.write(self, axis, entry, value)
        axis.ready, axis.entered = False, 0  # whatever the outcome, it has left its usual mode
        yield from self._bus.set_mode(self, axis, table.HOMING)
        self.launch()

    def launch(self) -> None:
        self.gate()
        self._bus.command(self._axis, table.OPERATE | table.NEW_SET_POINT)
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
            self._bus.command(self._axis, table.HOLD)
            self.exchange.release(self, ending)

    def _found(self) -> bool:
        """Returns whether it reports the end of this search."""
        sample, settled_ns = self._axis.sample, self._began_ns + 2 * self.exchange.period_ns
        if sample is None or sample.at_ns <= settled_ns:
            return False
        return self._axis.statusword & table.HOMING_STATUS == table.HOMING_DONE

    def _trouble(self, now_ns: int) -> TradeError | None:
        axis = self._axis
        if axis.statusword & table.HOMING_ERROR:
            return axis.fault_error("it has not found its home (statusword bit 13)")
        if now_ns >= min(self.until_ns or now_ns + 1, self._began_ns + _LONGEST_NS):
            return axis.fault_error("it has not found its home in time")
        return None


class Drive(BusMotor[DriveAxis, DriveExchange]):
    """One CiA 402 drive as a motor."""

    @service(effect="actuate", cancel="stop")
    def home(self, method: Method = 37, speed_rad_s: Slow | None = None) -> float:
        """Finds the zero of the joint, and returns the angle measured there.

        With most methods, the joint moves until it meets a switch or an index, regardless of limits(), since its
        position is unknown. No driver homes a joint by itself. The next move or enable() restores the usual mode.

        Raises:
            DeviceFault: the zero was not found, or the drive does not support the method.
            LimitExceeded: the speed is above limits().
            MotionStopped, DeviceSilent, DeadlineExceeded: as with move_to().
        """
        axis = self._axes[0]
        fastest = axis.joint.max_speed_rad_s
        speed = fastest / 10 if speed_rad_s is None else speed_rad_s
        within(speed, axis.resolution.rad_s, fastest, f"{axis.name} speed", "rad/s")
        with admitted(f"{self._name}.home", self.resources, span(self._exchange.clock)) as terms:
            self._finish(
                Homing(self._exchange, axis, terms, method=method, speed_counts=int(speed / axis.resolution.rad_s))
            )
        return axis.scale.angle_rad(axis.fresh(self._exchange.clock(), self._exchange.stale_after_ns).position)
