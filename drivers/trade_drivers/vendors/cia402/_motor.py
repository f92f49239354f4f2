"""A motor with homing, which only drives support."""

from typing import Annotated

from trade import Meta, service
from trade_drivers._validation import within
from trade_drivers.bus._gate import admitted, span
from trade_drivers.joints import BusMotor
from trade_drivers.vendors.cia402._axis import DriveAxis
from trade_drivers.vendors.cia402._cycle import DriveExchange
from trade_drivers.vendors.cia402._homing import Homing

Method = Annotated[int, Meta(ge=-128, le=37, description="homing method of CiA 402-2; 37: the zero is here")]
Slow = Annotated[float, Meta(gt=0, description="speed of the search in rad/s; by default a tenth of the joint's limit")]


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
