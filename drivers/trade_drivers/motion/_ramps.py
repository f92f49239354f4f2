"""The motion between two points of given speeds within limits: a ramp, a cruise, a ramp. Arithmetic only, no clock."""

from math import copysign, sqrt
from typing import Final, NamedTuple

from trade_drivers.motion._spline import CubicSegment

_OFF_RAD: Final = 1e-6
"""The deviation from a point that counts as rounding: no joint resolves it."""
_OFF_RAD_S: Final = 2e-6
"""The same for a change of speed."""
_DOUBLINGS: Final = 64


class RampSegment(NamedTuple):
    """The task between two points: from one angle and speed to another, in a given time.

    Among all motions within the limits, the one with ramps at the full acceleration around a cruise leaves the range
    between the two points least. So if it breaks a limit, every motion through these two points does.
    """

    begins_s: float
    duration_s: float
    start_rad: float
    end_rad: float
    before_rad_s: float
    after_rad_s: float

    @property
    def mean_rad_s(self) -> float:
        """The speed that it needs on average."""
        return (self.end_rad - self.start_rad) / self.duration_s

    def ramped(self, speed_rad_s: float, accel_rad_s2: float) -> list[CubicSegment] | None:
        """Returns its motion within these limits, which must include the speeds at both points; None: there is none."""
        most = accel_rad_s2 * self.duration_s
        before, after = self.before_rad_s, self.after_rad_s
        end = max(before - most, min(before + most, after))
        if abs(end - after) > _OFF_RAD_S:
            return None
        within = self._replace(after_rad_s=end)
        pieces = within._at(max(-speed_rad_s, min(speed_rad_s, within._cruise_rad_s(accel_rad_s2))), accel_rad_s2)
        reached_rad, _ = pieces[-1].at(pieces[-1].duration_s)
        return pieces if abs(reached_rad - self.end_rad) <= _OFF_RAD else None

    def least_accel_rad_s2(self, speed_rad_s: float) -> float:
        """Returns the acceleration that it needs at least, with the sign of its first change of speed."""
        enough = max(1e-6, abs(self.after_rad_s - self.before_rad_s) / self.duration_s)
        lower = enough / 2
        for _ in range(_DOUBLINGS):
            if self.ramped(speed_rad_s, enough) is not None:
                break
            lower, enough = enough, 2 * enough
        for _ in range(_DOUBLINGS):
            middle = (lower + enough) / 2
            lower, enough = (lower, middle) if self.ramped(speed_rad_s, middle) else (middle, enough)
        return copysign(enough, self._cruise_rad_s(enough) - self.before_rad_s or self.after_rad_s - self.before_rad_s)

    def _cruise_rad_s(self, accel: float) -> float:
        """Returns the speed of the cruise; that of the greatest possible displacement if even this is too short."""
        duration, way = self.duration_s, self.end_rad - self.start_rad
        low, high = sorted((self.before_rad_s, self.after_rad_s))
        ramp, rest = (high * high - low * low) / (2 * accel), max(0.0, duration - (high - low) / accel)
        if ramp + low * rest <= way <= ramp + high * rest:
            return min(high, max(low, (way - ramp) / rest)) if rest else high  # rounding counts if there is no rest
        sign = 1.0 if way > ramp + high * rest else -1.0
        peak = (accel * duration + sign * (low + high)) / 2
        return sign * (peak - sqrt(max(0.0, peak * peak - (low * low + high * high) / 2 - accel * sign * way)))

    def _at(self, cruise: float, accel: float) -> list[CubicSegment]:
        """Returns the pieces: a ramp to the speed of the cruise, the cruise, and a ramp to the speed at the end."""
        first, last = (abs(cruise - speed) / accel for speed in (self.before_rad_s, self.after_rad_s))
        pieces: list[CubicSegment] = []
        at_s, position, velocity = self.begins_s, self.start_rad, self.before_rad_s
        for duration, rate in (
            (first, copysign(accel, cruise - self.before_rad_s)),
            (self.duration_s - first - last, 0.0),
            (last, copysign(accel, self.after_rad_s - cruise)),
        ):
            if duration > 0:
                pieces.append(CubicSegment(at_s, duration, position, velocity, rate, 0.0))
                position, velocity = pieces[-1].at(duration)
                at_s += duration
        return pieces
