"""How a shaft moves: position and speed as a function of time, with limited acceleration. Pure: time is an argument.

Units: counts, counts/s, counts/s^2; time in seconds on whatever clock the caller uses.
"""

from dataclasses import dataclass, field
from itertools import pairwise
from math import copysign, sqrt


@dataclass(frozen=True, slots=True)
class Course:
    """A motion made of stretches of constant acceleration, then constant speed."""

    begins: float
    position: float
    speed: float
    stretches: tuple[tuple[float, float], ...] = ()
    """Pairs of duration and acceleration."""
    goal: float | None = None
    """The exact end position, if it ends at rest at a requested position."""
    ends: float = field(init=False)
    """When the last stretch is over."""
    final_speed: float = field(init=False)
    """Speed after the last stretch."""

    def __post_init__(self) -> None:
        """Compute the values that are queried most often."""
        lasts, speed = 0.0, self.speed
        for duration, acceleration in self.stretches:
            lasts += duration
            speed += duration * acceleration
        object.__setattr__(self, "ends", self.begins + lasts)
        object.__setattr__(self, "final_speed", 0.0 if self.goal is not None or abs(speed) < 1e-6 else speed)

    def at(self, t: float) -> tuple[float, float, float]:
        """Position, speed and acceleration at time `t`."""
        position, speed, left = self.position, self.speed, max(0.0, t - self.begins)
        over = t >= self.ends
        if over and self.goal is not None:
            return self.goal, 0.0, 0.0
        for duration, acceleration in self.stretches:
            if left < duration and not over:
                moved = speed * left + acceleration * left * left / 2
                return position + moved, speed + acceleration * left, acceleration
            position += speed * duration + acceleration * duration * duration / 2
            speed += acceleration * duration
            left = max(0.0, left - duration)
        return position + self.final_speed * left, self.final_speed, 0.0


def at_rest(t: float, position: float) -> Course:
    """Stay where it is."""
    return Course(t, position, 0.0)


def to_speed(t: float, position: float, speed: float, wanted: float, acceleration: float) -> Course:
    """Change speed at the given rate, then keep it."""
    change = wanted - speed
    if change == 0.0:
        return Course(t, position, speed)
    return Course(t, position, speed, ((abs(change) / acceleration, copysign(acceleration, change)),))


def to_position(t: float, position: float, speed: float, goal: float, top_speed: float, acceleration: float) -> Course:
    """Go to a place and stop there: a trapezoid of speed, or a triangle if the way is short.

    Moving the wrong way, or too fast to stop in time, it brakes first and comes back.
    """
    stops_at = position + speed * abs(speed) / (2 * acceleration)
    way = 1.0 if goal >= stops_at else -1.0
    distance, ahead = way * (goal - position), way * speed
    if distance == 0.0 and ahead == 0.0:
        return Course(t, position, 0.0, goal=goal)
    speeds, cruise_s = _trapezoid(distance, ahead, top_speed, acceleration)
    changes = [(abs(b - a) / acceleration, copysign(acceleration, way * (b - a))) for a, b in pairwise(speeds)]
    stretches = [changes[0], (cruise_s, 0.0), *changes[1:]]
    return Course(t, position, speed, tuple(stretch for stretch in stretches if stretch[0] > 0.0), goal)


def _trapezoid(distance: float, speed: float, top_speed: float, acceleration: float) -> tuple[list[float], float]:
    """Speeds at the corners (now, cruising, at rest) and the time spent cruising."""
    if speed >= top_speed:
        braking = speed * speed / (2 * acceleration)
        return [speed, top_speed, 0.0], max(0.0, distance - braking) / top_speed
    peak = sqrt(max(0.0, acceleration * distance + speed * speed / 2))
    if peak <= top_speed:
        return [speed, max(peak, speed), 0.0], 0.0
    ramps = (2 * top_speed * top_speed - speed * speed) / (2 * acceleration)
    return [speed, top_speed, 0.0], (distance - ramps) / top_speed
