"""Generators of cyclic set-points (positions or velocities) for modes without a goal. No I/O."""

from math import copysign, sqrt

from trade_drivers.joints import Ramp, Sample, towards
from trade_drivers.vendors.cia402 import _table as table


class Following(Ramp):
    """Cyclic synchronous position: each position is reached one period after the SYNC that activates it."""

    def __init__(self, node: int, position: int, *, speed: float, accel: float, period_s: float) -> None:
        super().__init__(position, fastest=speed, accel=accel, braking=accel / 2)
        self.can_id = table.FOLLOWING.base + node
        self._period_s = period_s

    def next(self, sample: Sample, now_ns: int) -> bytes:  # noqa: ARG002 - that is the drive's own business in this mode
        """Returns the frame data for the next period."""
        self.step(self._period_s)
        return table.FOLLOWING.layout.pack(self.target)

    @property
    def target(self) -> int:
        """The last set-point."""
        return round(self.position)


class Turning:
    """Cyclic synchronous velocity, or profile velocity with ramps of the same steepness.

    The velocity is 0 until the end and the speed are set. It slows down early enough for the drive to stop within the
    range even if the driver's frames stop, which the drive notices after ``blind_s``. Without a new measurement, it
    assumes that the joint follows the commanded velocity.

    The drive's own units of speed and acceleration are so many counts/s and counts/s^2 of its positions.
    """

    def __init__(
        self,
        node: int,
        *,
        accel: int,
        period_s: float,
        blind_s: float,
        speed_unit: float = 1.0,
        accel_unit: float = 1.0,
    ) -> None:
        self.can_id = table.TURNING.base + node
        self.end: int | None = None
        """The end of its motion, in counts."""
        self.fastest = 0.0
        """Speed in the drive's own unit, without a sign."""
        self._speed = 0.0
        self._ramp, self._accel, self._speed_unit = accel, accel * accel_unit, speed_unit
        self._period_s, self._blind_s = period_s, blind_s
        self._measured_ns = self._sent_ns = 0
        self._travelled = 0.0
        """Expected motion since the last measurement, in counts."""

    def next(self, sample: Sample, now_ns: int) -> bytes:
        """Returns the frame data for the next period, from the newest measurement."""
        if sample.at_ns == self._measured_ns:
            self._travelled += self._speed * (now_ns - self._sent_ns) / 1e9
        else:
            self._travelled = self._speed * (now_ns - sample.at_ns) / 1e9
        self._measured_ns, self._sent_ns = sample.at_ns, now_ns
        wanted = 0.0 if self.end is None else self._allowed(self.end - sample.position - self._travelled)
        self._speed = towards(self._speed, wanted, self._accel * self._period_s)
        speed = int(round(self._speed / self._speed_unit, 6))  # never faster than allowed
        return table.TURNING.layout.pack(self._ramp, speed)

    def _allowed(self, left: float) -> float:
        blind = self._accel * self._blind_s
        return copysign(
            min(self.fastest * self._speed_unit, sqrt(blind * blind + 2 * self._accel * abs(left)) - blind), left
        )


def interpolation_period(rate_hz: float) -> tuple[int, int]:
    """Returns a period for object 60C2h: a number below 256, and a power of ten in s."""
    for exponent in (-3, -4, -5, -6):  # all drives accept whole milliseconds
        count = 10.0**-exponent / rate_hz
        if abs(count - round(count)) < 1e-3 and round(count) < 256:
            return round(count), exponent
    exponent = next(exponent for exponent in (-5, -4, -3, -2, -1, 0) if 10.0**-exponent / rate_hz < 255)
    return round(10.0**-exponent / rate_hz), exponent
