"""The way of an arm: set-points towards a target, and the poses of a tool along a straight line. Arithmetic only.

A pose is x, y, z in m and a rotation vector in rad; on a line the tool turns about one axis, at an even rate.
"""

from collections.abc import Sequence
from math import atan2, ceil, copysign, cos, dist, hypot, sin, sqrt
from typing import Final

_EVERY_M: Final = 0.05
_EVERY_RAD: Final = 0.2

Quaternion = tuple[float, float, float, float]


class SetpointFilter:
    """Generates the set-points of several joints, cycle by cycle, within limits of speed and acceleration.

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


def poses_on(start: Sequence[float], goal: Sequence[float]) -> list[list[float]]:
    """Returns poses from start to goal, at most 5 cm and 0.2 rad apart, as the controller does; last the goal."""
    first = _quaternion(start[3:])
    turn = _vector(_product(_quaternion(goal[3:]), _inverse(first)))
    count = max(1, ceil(dist(start[:3], goal[:3]) / _EVERY_M), ceil(hypot(*turn) / _EVERY_RAD))
    poses: list[list[float]] = []
    for k in range(1, count):
        place = [a + (b - a) * k / count for a, b in zip(start[:3], goal[:3], strict=True)]
        poses.append([*place, *_vector(_product(_quaternion([angle * k / count for angle in turn]), first))])
    return [*poses, list(goal)]


def _quaternion(vector: Sequence[float]) -> Quaternion:
    angle = hypot(*vector)
    scale = sin(angle / 2) / angle if angle else 0.5
    x, y, z = (component * scale for component in vector)
    return cos(angle / 2), x, y, z


def _vector(rotation: Quaternion) -> tuple[float, float, float]:
    w, x, y, z = rotation if rotation[0] >= 0 else tuple(-part for part in rotation)
    length = hypot(x, y, z)
    scale = 2 * atan2(length, w) / length if length else 0.0
    return x * scale, y * scale, z * scale


def _inverse(rotation: Quaternion) -> Quaternion:
    w, x, y, z = rotation
    return w, -x, -y, -z


def _product(a: Quaternion, b: Quaternion) -> Quaternion:
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )
