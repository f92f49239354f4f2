"""From where a joint is told to be to where it is to be, a step in every cycle: for devices without ramps. No I/O."""

from math import copysign, sqrt
from typing import Final

__all__ = ["Ramp", "towards"]

_SLACK: Final = 1.02
"""A plan that uses all of a joint's acceleration is followed in whole counts."""


class Ramp:
    """It stands where it begins until it is aimed elsewhere. Its aim may jump; it keeps speed and acceleration.

    Args:
        position: where it begins, in counts.
        fastest: counts/s.
        accel: counts/s^2.
        braking: with what it ends a way, in counts/s^2; less than all where its aim moves on.
    """

    def __init__(self, position: int, *, fastest: float, accel: float, braking: float) -> None:
        self.aim = position
        """Where it is to be after the next step, or some steps later, in counts."""
        self.position = self._aimed = float(position)
        self.speed = 0.0
        self.fastest, self.accel, self.braking = fastest, accel, braking

    def step(self, period_s: float) -> float:
        """Where it is to be one period later."""
        planned, behind = (self.aim - self._aimed) / period_s, self._aimed - self.position
        self._aimed = self.aim
        wanted = planned + copysign(self._catching_up(abs(behind), period_s), behind)
        wanted = max(-self.fastest, min(self.fastest, wanted))
        self.speed = towards(self.speed, wanted, self.accel * _SLACK * period_s)
        self.position += self.speed * period_s
        return self.position

    def _catching_up(self, behind: float, period_s: float) -> float:
        """The speed from which its braking ends the way in time; what is left at last goes in a period."""
        step = self.braking / 2 * period_s
        return min(behind / period_s, sqrt(step * step + 2 * self.braking * behind) - step)

    def jump(self, aim: int) -> None:
        """Another aim, that is not where the one before would have gone on to."""
        self.aim = aim
        self._aimed = float(aim)


def towards(speed: float, wanted: float, change: float) -> float:
    """A speed, changed by so much at most."""
    return speed + max(-change, min(change, wanted - speed))
