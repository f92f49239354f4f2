"""A ramp generator for devices without their own: moves the set-point one step per cycle. No I/O."""

from math import copysign, sqrt
from typing import Final

_SLACK: Final = 1.02
"""Reserve for rounding to whole counts in plans that use all of a joint's acceleration."""


class Ramp:
    """A set-point that follows an aim within limits of speed and acceleration. The aim may jump.

    Args:
        position: the initial set-point and aim, in counts.
        fastest: maximum speed in counts/s.
        accel: maximum acceleration in counts/s^2.
        braking: deceleration towards the aim in counts/s^2; below the maximum where the aim moves.
    """

    def __init__(self, position: int, *, fastest: float, accel: float, braking: float) -> None:
        self.aim = position
        """The aim: the set-point after the next step or some steps later, in counts."""
        self.position = self._aimed = float(position)
        self.speed = 0.0
        self.fastest, self.accel, self.braking = fastest, accel, braking

    def step(self, period_s: float) -> float:
        """Returns the set-point one period later."""
        planned, behind = (self.aim - self._aimed) / period_s, self._aimed - self.position
        self._aimed = self.aim
        wanted = planned + copysign(self._catching_up(abs(behind), period_s), behind)
        wanted = max(-self.fastest, min(self.fastest, wanted))
        self.speed = towards(self.speed, wanted, self.accel * _SLACK * period_s)
        self.position += self.speed * period_s
        return self.position

    def _catching_up(self, behind: float, period_s: float) -> float:
        """Returns the speed from which braking ends at the aim; the last remainder takes one period."""
        step = self.braking / 2 * period_s
        return min(behind / period_s, sqrt(step * step + 2 * self.braking * behind) - step)

    def jump(self, aim: int) -> None:
        """Sets an aim that does not continue the previous one."""
        self.aim = aim
        self._aimed = float(aim)


def towards(speed: float, wanted: float, change: float) -> float:
    """Returns the speed, changed towards the wanted one by at most ``change``."""
    return speed + max(-change, min(change, wanted - speed))
