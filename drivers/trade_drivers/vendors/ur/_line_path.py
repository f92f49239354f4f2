"""The poses of a tool along a straight line, as the controller interpolates it. Pure arithmetic.

A pose is x, y, z in m and a rotation vector in rad; on the way the tool turns about one axis, at an even rate.
"""

from collections.abc import Sequence
from math import atan2, ceil, cos, dist, hypot, sin
from typing import Final

_EVERY_M: Final = 0.05
_EVERY_RAD: Final = 0.2

Quaternion = tuple[float, float, float, float]


def poses_on(start: Sequence[float], goal: Sequence[float]) -> list[list[float]]:
    """Returns poses from start to goal, at most 5 cm and 0.2 rad apart; the last is the goal."""
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
