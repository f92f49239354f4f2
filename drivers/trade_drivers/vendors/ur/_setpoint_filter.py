"""A set-point that moves towards its target within limits of speed and acceleration. Arithmetic only, no clock."""

from collections.abc import Sequence
from math import copysign, sqrt


class SetpointFilter:
    """Generates the set-points of several joints, cycle by cycle.

    Args:
        positions: the current positions, in rad.
        speed: the maximum, in rad/s.
        accel: the maximum, in rad/s^2.
    """

    def __init__(self, positions: Sequence[float], speed: float, accel: float) -> None:
        self.positions = list(positions)
        self.speeds = [0.0] * len(self.positions)
        self._speed, self._accel = speed, accel

    def step(self, targets: Sequence[float], dt: float) -> list[float]:
        """Returns the set-points ``dt`` s later: each joint approaches its target so that it can stop there."""
        most = self._accel * dt
        for joint, target in enumerate(targets):
            way = target - self.positions[joint]
            speed = self.speeds[joint]
            if abs(way) <= most * dt and abs(speed) <= most:
                self.positions[joint], self.speeds[joint] = target, 0.0
                continue
            # half a step passes before braking takes effect
            braked = max(0.0, sqrt(most * most / 4 + 2 * self._accel * abs(way)) - most / 2)
            wanted = copysign(min(self._speed, braked, abs(way) / dt), way)
            speed += max(-most, min(most, wanted - speed))
            self.speeds[joint] = speed
            self.positions[joint] += speed * dt
        return list(self.positions)
