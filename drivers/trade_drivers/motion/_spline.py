"""Cubic splines of angles over time, smooth in angle and speed. Arithmetic only, no clock."""

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from itertools import pairwise
from math import copysign, sqrt
from typing import Final, NamedTuple


class CubicSegment(NamedTuple):
    """The cubic piece between two points, with a constant jerk."""

    begins_s: float
    duration_s: float
    position_rad: float
    velocity_rad_s: float
    accel_rad_s2: float
    jerk_rad_s3: float

    def at(self, time_s: float) -> tuple[float, float]:
        """Returns the angle in rad and the speed in rad/s at a time after the piece began."""
        t, a, j = time_s, self.accel_rad_s2, self.jerk_rad_s3
        position = self.position_rad + t * (self.velocity_rad_s + t * (a / 2 + t * j / 6))
        return position, self.velocity_rad_s + t * (a + t * j / 2)

    def accels(self) -> tuple[float, float]:
        """Returns the acceleration in rad/s^2 at both ends, which is the greatest of the piece."""
        return self.accel_rad_s2, self.accel_rad_s2 + self.jerk_rad_s3 * self.duration_s

    def speeds(self) -> list[float]:
        """Returns the speed in rad/s at both ends and at its extreme in between."""
        times = [0.0, self.duration_s]
        if self.jerk_rad_s3 and 0 < (turn := -self.accel_rad_s2 / self.jerk_rad_s3) < self.duration_s:
            times.append(turn)
        return [self.at(time)[1] for time in times]

    def angles(self) -> list[float]:
        """Returns the angle in rad at both ends and at its turning points."""
        return [self.at(time)[0] for time in (0.0, self.duration_s, *self._still())]

    def _still(self) -> Iterator[float]:
        """Yields the times when the speed is zero."""
        v, a, j = self.velocity_rad_s, self.accel_rad_s2, self.jerk_rad_s3
        if (inside := a * a - 2 * j * v) < 0:
            return
        q = -(a + copysign(sqrt(inside), a))  # avoids the difference of two nearly equal numbers
        roots = ([q / j] if j else []) + ([2 * v / q] if q else [])
        yield from (root for root in roots if 0 < root < self.duration_s)


class Curve:
    """One joint's path through its points; it holds the first angle before and the last angle after."""

    __slots__ = ("_begins", "pieces")

    def __init__(self, pieces: Sequence[CubicSegment]) -> None:
        self.pieces = tuple(pieces)
        self._begins = [piece.begins_s for piece in pieces]

    @classmethod
    def through(
        cls, times_s: Sequence[float], positions_rad: Sequence[float], velocities_rad_s: Sequence[float] | None = None
    ) -> "Curve":
        """Returns a curve through at least two points at strictly increasing times.

        Without velocities, it is at rest at both ends and overshoots no point: the speed at a point is zero where the
        direction changes, otherwise the weighted harmonic mean of the slopes on both sides.
        """
        points = list(zip(times_s, positions_rad, strict=True))
        speeds = _chosen(points) if velocities_rad_s is None else velocities_rad_s
        ends = zip(pairwise(points), pairwise(speeds), strict=True)
        return cls([cubic(*first, *second, *both) for (first, second), both in ends])

    @property
    def duration_s(self) -> float:
        """The duration in seconds."""
        last = self.pieces[-1]
        return last.begins_s + last.duration_s

    def at(self, time_s: float) -> tuple[float, float]:
        """Returns the angle in rad and the speed in rad/s."""
        time_s = max(0.0, time_s)
        if time_s >= self.duration_s:
            return self.pieces[-1].at(self.pieces[-1].duration_s)[0], 0.0
        piece = self.pieces[bisect_right(self._begins, time_s) - 1]
        return piece.at(time_s - piece.begins_s)


def cubic(begins_s: float, start: float, ends_s: float, end: float, before: float, after: float) -> CubicSegment:
    """Returns the cubic piece between two points, each a time in s, an angle in rad, and a speed in rad/s."""
    duration = ends_s - begins_s
    slope = (end - start) / duration
    accel = 2 / duration * (3 * slope - 2 * before - after)
    jerk = 6 / duration**2 * (before + after - 2 * slope)
    return CubicSegment(begins_s, duration, start, before, accel, jerk)


def _chosen(points: Sequence[tuple[float, float]]) -> list[float]:
    """Returns the speed at each point, after Fritsch and Butland (1984)."""
    steps = [(b[0] - a[0], (b[1] - a[1]) / (b[0] - a[0])) for a, b in pairwise(points)]
    inner = [
        0.0 if before * after <= 0 else 3 * (short + long) / ((2 * long + short) / before + (long + 2 * short) / after)
        for (short, before), (long, after) in pairwise(steps)
    ]
    return [0.0, *inner, 0.0]


class JointTask(NamedTuple):
    """One joint's task: its start, current speed, goal and limits."""

    start_rad: float
    velocity_rad_s: float
    goal_rad: float
    speed_rad_s: float
    accel_rad_s2: float

    @property
    def braking_s(self) -> float:
        """The time to come to rest; less than a millisecond counts as zero."""
        braking_s = abs(self.velocity_rad_s) / self.accel_rad_s2
        return braking_s if braking_s > _SHORT_S else 0.0

    @property
    def rest_rad(self) -> float:
        """The angle where the joint comes to rest."""
        return self.start_rad + self.velocity_rad_s * self.braking_s / 2


_NEAR_RAD: Final = 1e-6
"""A goal nearer than this is reached."""
_SHORT_S: Final = 1e-3
"""Shorter pieces are left out, as they are numerically imprecise."""
_LEAST_S: Final = 0.01
"""The duration of a path without length."""


def there_together(ways: Sequence[JointTask]) -> list[Curve]:
    """Returns curves that start and arrive together, in a straight line after moving joints have braked.

    All share one trapezoidal speed profile: that of the slowest joint.
    """
    braking_s = max(way.braking_s for way in ways)
    distances = [abs(way.goal_rad - way.rest_rad) for way in ways]
    far = [(way, distance) for way, distance in zip(ways, distances, strict=True) if distance > _NEAR_RAD]
    ramp_s, cruise_s = _LEAST_S, 0.0
    if far:
        rate = min(way.speed_rad_s / distance for way, distance in far)
        gain = min(way.accel_rad_s2 / distance for way, distance in far)
        ramp_s, cruise_s = (rate / gain, 1 / rate - rate / gain) if rate * rate < gain else (sqrt(1 / gain), 0.0)
    if cruise_s < _SHORT_S:
        ramp_s, cruise_s = ramp_s + cruise_s, 0.0
    sets_off_s = braking_s + _LEAST_S if braking_s else 0.0
    return [_trapezoid(way, sets_off_s, ramp_s, cruise_s) for way in ways]


def _trapezoid(way: JointTask, sets_off_s: float, ramp_s: float, cruise_s: float) -> Curve:
    rest = way.rest_rad
    speed = (way.goal_rad - rest) / (ramp_s + cruise_s)
    knots = [(0.0, way.start_rad, way.velocity_rad_s if way.braking_s else 0.0)]
    for time_s, position, velocity in (
        (way.braking_s, rest, 0.0),
        (sets_off_s, rest, 0.0),
        (sets_off_s + ramp_s, rest + speed * ramp_s / 2, speed),
        (sets_off_s + ramp_s + cruise_s, way.goal_rad - speed * ramp_s / 2, speed),
        (sets_off_s + 2 * ramp_s + cruise_s, way.goal_rad, 0.0),
    ):
        if time_s > knots[-1][0]:
            knots.append((time_s, position, velocity))
    times, positions, velocities = zip(*knots, strict=True)
    return Curve.through(times, positions, velocities)
