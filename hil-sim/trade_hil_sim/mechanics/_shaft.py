"""A shaft and its demand. Counts, counts/s, counts/s^2; time is an argument."""

from math import copysign, inf
from typing import Final

from trade_hil_sim.mechanics._profile import Course, at_rest, to_position, to_speed

STILL: Final = 1e-6
"""Counts per second below which nothing moves."""


class Shaft:
    """Where the trajectory generator wants the shaft, and where it is: the same, unless it is held or cannot follow.

    Args:
        position: where it is, in counts.
        t: the start time.
    """

    def __init__(self, position: float, t: float) -> None:
        self.demand = self.actual = at_rest(t, position)
        self.jammed = False
        self.settles_at: float | None = None
        """When a set-point that it could not follow should have been reached; the shaft moves there from then on."""

    def position(self, t: float) -> float:
        """Where it is."""
        return self.actual.at(t)[0]

    def speed(self, t: float) -> float:
        """How fast it turns."""
        return self.actual.at(t)[1]

    def moving(self, t: float) -> bool:
        """Whether it turns, or is about to."""
        return abs(self.actual.final_speed) > STILL or (t < self.actual.ends and bool(self.actual.stretches))

    def rests_at(self, t: float) -> float:
        """When it comes to rest by itself; infinity if it has, or does not."""
        ends = self.actual.ends
        return ends if ends > t and self.moving(t) and not self.actual.final_speed else inf

    def next_corner(self, t: float) -> float:
        """When its acceleration changes next, after `t`."""
        corner = self.actual.begins
        for duration, _ in self.actual.stretches:
            corner += duration
            if corner > t:
                return corner
        return inf

    @property
    def parted(self) -> bool:
        """Whether its position may differ from the demand."""
        return self.demand is not self.actual

    def behind(self, t: float) -> float:
        """The following error: demanded less actual position."""
        return self.demand.at(t)[0] - self.position(t) if self.parted else 0.0

    def go(self, t: float, goal: float, top_speed: float, acceleration: float) -> None:
        """Go to a place and stop there."""
        self._demand(to_position(t, *self.actual.at(t)[:2], goal, max(top_speed, STILL), acceleration), t)

    def spin(self, t: float, speed: float, acceleration: float) -> None:
        """Change speed and keep it."""
        self._demand(to_speed(t, *self.actual.at(t)[:2], speed, acceleration), t)

    def track(self, t: float, goal: float, period_s: float, top_speed: float, acceleration: float) -> None:
        """Be at a place one period from now, as near as speed and acceleration allow: one of a train of set-points."""
        wanted_at = self.demand.at(t)[0]
        demand = Course(t, wanted_at, (goal - wanted_at) / period_s, ((period_s, 0.0),), goal)
        position, speed, _ = self.actual.at(t)
        wanted = (goal - position) / period_s
        change = min(abs(wanted - speed), acceleration * period_s)
        can = speed + copysign(change, wanted - speed)
        can = copysign(min(abs(can), top_speed), can)
        self.settles_at = None
        if abs(wanted) < STILL and abs(speed) < STILL and not self.jammed:
            self.demand = self.actual = Course(t, goal, 0.0, (), goal)
        elif self.jammed or abs(can - wanted) > STILL:
            self.demand = demand
            self.settles_at = None if self.jammed else t + period_s
            self.actual = self.actual if self.jammed else Course(t, position, can, ((period_s, 0.0),))
        else:
            self.demand = self.actual = Course(t, position, wanted, ((period_s, 0.0),), goal)

    def settle(self, t: float, top_speed: float, acceleration: float) -> None:
        """Move to the set-point that the shaft could not follow."""
        self.settles_at = None
        position, speed, _ = self.actual.at(t)
        goal = self.demand.goal
        if goal is not None and not self.jammed:
            self.actual = to_position(t, position, speed, goal, top_speed, acceleration)

    def rejoin(self, t: float) -> None:
        """Once it has reached the demand, let both move together again."""
        if self.parted and not self.moving(t) and t >= self.demand.ends and abs(self.behind(t)) < STILL:
            self.demand = self.actual

    def place(self, position: float, t: float) -> None:
        """Turn it by hand."""
        self.actual = at_rest(t, position)
        self.settles_at = None

    def jam(self, on: bool, t: float) -> None:
        """Jam it, or release it."""
        self.jammed = on
        if on:
            self.place(self.position(t), t)

    def forget(self, t: float) -> None:
        """Set the demand to the actual position."""
        self.settles_at = None
        if self.parted:
            self.demand = self.actual = at_rest(t, self.position(t)) if self.jammed else self.actual

    def _demand(self, course: Course, t: float) -> None:
        self.settles_at = None
        self.demand = course
        self.actual = at_rest(t, self.position(t)) if self.jammed else course
