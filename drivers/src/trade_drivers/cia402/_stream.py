"""Set-points for modes without a goal, one in every cycle: where to be, or how fast to turn. No I/O."""

from math import copysign, sqrt
from typing import Final

from trade_drivers.cia402 import _table as table
from trade_drivers.joints import Sample

__all__ = ["Following", "Turning", "interpolation_period"]

_SLACK: Final = 1.02
"""A plan that uses all of a joint's acceleration is followed in whole counts."""


class Following:
    """Positions, each reached one period after the SYNC that makes it count: cyclic synchronous position.

    It stands where it begins until it is aimed elsewhere. Its aim may jump; it keeps speed and acceleration.
    """

    def __init__(self, node: int, position: int, *, speed: float, accel: float, period_s: float) -> None:
        self.can_id = table.FOLLOWING.base + node
        self.aim = position
        """Where it is to be one period after the position before, in counts."""
        self.position = self._aimed = float(position)
        self._speed = 0.0
        self._fastest, self._accel, self._period_s = speed, accel, period_s

    def next(self, sample: Sample, now_ns: int) -> bytes:  # noqa: ARG002 - that is the drive's own business in this mode
        """The data of the frame for one period more."""
        planned, behind = (self.aim - self._aimed) / self._period_s, self._aimed - self.position
        self._aimed = self.aim
        wanted = planned + copysign(self._catching_up(abs(behind)), behind)
        wanted = max(-self._fastest, min(self._fastest, wanted))
        self._speed = _towards(self._speed, wanted, self._accel * _SLACK * self._period_s)
        self.position += self._speed * self._period_s
        return table.FOLLOWING.layout.pack(self.target)

    @property
    def target(self) -> int:
        """What the drive was sent last."""
        return round(self.position)

    def _catching_up(self, behind: float) -> float:
        """The speed from which half of the acceleration ends the way in time; what is left at last goes in a period."""
        accel, step = self._accel / 2, self._accel / 4 * self._period_s
        return min(behind / self._period_s, sqrt(step * step + 2 * accel * behind) - step)


class Turning:
    """Speeds: cyclic synchronous velocity, or profile velocity, whose own ramps are as steep.

    It stands until it is given an end and a speed. It slows down before the end in time for the drive to stop within
    the range by itself, should the driver fall silent: after ``blind_s``. While nothing new is measured it takes the
    joint to go on as it was told.
    """

    def __init__(self, node: int, *, accel: int, period_s: float, blind_s: float) -> None:
        self.can_id = table.TURNING.base + node
        self.end: int | None = None
        """Where it must not go beyond, in counts."""
        self.fastest = 0.0
        """In counts/s, without a sign."""
        self._speed = 0.0
        self._accel, self._period_s, self._blind_s = accel, period_s, blind_s
        self._measured_ns = self._told_ns = 0
        self._travelled = 0.0
        """How far it must have got since it was measured, in counts."""

    def next(self, sample: Sample, now_ns: int) -> bytes:
        """The data of the frame for one period more, where that was measured last."""
        if sample.at_ns == self._measured_ns:
            self._travelled += self._speed * (now_ns - self._told_ns) / 1e9
        else:
            self._travelled = self._speed * (now_ns - sample.at_ns) / 1e9
        self._measured_ns, self._told_ns = sample.at_ns, now_ns
        wanted = 0.0 if self.end is None else self._allowed(self.end - sample.position - self._travelled)
        self._speed = _towards(self._speed, wanted, self._accel * self._period_s)
        return table.TURNING.layout.pack(self._accel, round(self._speed))

    def _allowed(self, left: float) -> float:
        blind = self._accel * self._blind_s
        return copysign(min(self.fastest, sqrt(blind * blind + 2 * self._accel * abs(left)) - blind), left)


def interpolation_period(rate_hz: float) -> tuple[int, int]:
    """A period as object 60C2h has it: a number below 256, and the power of ten of its unit."""
    for exponent in (-3, -4, -5, -6):  # whole milliseconds are what every drive takes
        count = 10.0**-exponent / rate_hz
        if abs(count - round(count)) < 1e-3 and round(count) < 256:
            return round(count), exponent
    exponent = next(exponent for exponent in (-5, -4, -3, -2, -1, 0) if 10.0**-exponent / rate_hz < 255)
    return round(10.0**-exponent / rate_hz), exponent


def _towards(speed: float, wanted: float, change: float) -> float:
    return speed + max(-change, min(change, wanted - speed))
