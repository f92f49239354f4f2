"""Forward and inverse kinematics of an arm's flange. Pure arithmetic.

A pose is x, y, z in m and a rotation vector in rad, as the controller has it.
"""

from collections.abc import Sequence
from math import acos, cos, pi, sin, sqrt
from typing import Final

from ._table import Model

Matrix = tuple[tuple[float, ...], ...]
"""A transformation in three rows: a rotation, and a position in the fourth column."""

_ALPHA: Final = (pi / 2, 0.0, 0.0, pi / 2, -pi / 2, 0.0)
_STEP_RAD: Final = 1e-6
_NEAR: Final = 1e-9
_ROUNDS: Final = 50
_DAMPING: Final = 1e-6


def flange(model: Model, q: Sequence[float]) -> Matrix:
    """The flange in the frame of the base, for joint angles in rad."""
    whole: Matrix = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))
    for joint in range(6):
        c, s, ca, sa = cos(q[joint]), sin(q[joint]), cos(_ALPHA[joint]), sin(_ALPHA[joint])
        a, d = model.a[joint], model.d[joint]
        whole = tuple(
            (
                r[0] * c + r[1] * s,
                -r[0] * s * ca + r[1] * c * ca + r[2] * sa,
                r[0] * s * sa - r[1] * c * sa + r[2] * ca,
                r[0] * a * c + r[1] * a * s + r[2] * d + r[3],
            )
            for r in whole
        )
    return whole


def pose_of(matrix: Matrix) -> tuple[float, ...]:
    """The flange as a pose."""
    return (*(row[3] for row in matrix), *_rotation_vector(matrix))


def pose_between(start: Sequence[float], goal: Sequence[float], part: float) -> tuple[float, ...]:
    """A pose on the straight path between two, with constant rotation speed."""
    first, turn = _rotation(start[3:]), _turn(start, goal)
    matrix = _times(_rotation([part * angle for angle in turn]), first)
    place = (a + part * (b - a) for a, b in zip(start[:3], goal[:3], strict=True))
    return (*place, *_rotation_vector(matrix))


def way_of(start: Sequence[float], goal: Sequence[float]) -> tuple[float, float]:
    """The distance between two poses: in m and in rad."""
    return _norm([b - a for a, b in zip(start[:3], goal[:3], strict=True)]), _norm(_turn(start, goal))


def joints_for(model: Model, pose: Sequence[float], near: Sequence[float]) -> tuple[float, ...] | None:
    """Joint angles in rad for a pose, near given ones; None if it is out of reach.

    Damped Newton: it goes to the solution next to where it starts.
    """
    q = list(near)
    for _ in range(_ROUNDS):
        now = flange(model, q)
        error = _error(now, pose)
        if _norm(error) < _NEAR:
            return tuple(q)
        columns: list[list[float]] = []
        for joint in range(6):
            q[joint] += _STEP_RAD
            there = _error(flange(model, q), pose)
            q[joint] -= _STEP_RAD
            columns.append([(a - b) / _STEP_RAD for a, b in zip(error, there, strict=True)])
        step = _least_squares(columns, error)
        longest = max(1.0, max(abs(angle) for angle in step) / 0.3)
        q = [angle + change / longest for angle, change in zip(q, step, strict=True)]
    return tuple(q) if _norm(_error(flange(model, q), pose)) < 1e-6 else None


def _error(now: Matrix, pose: Sequence[float]) -> list[float]:
    wanted = _rotation(pose[3:])
    turn = _rotation_vector(_times(wanted, _transposed(now)))
    return [*(pose[row] - now[row][3] for row in range(3)), *turn]


def _turn(start: Sequence[float], goal: Sequence[float]) -> tuple[float, ...]:
    return _rotation_vector(_times(_rotation(goal[3:]), _transposed(_rotation(start[3:]))))


def _rotation(vector: Sequence[float]) -> Matrix:
    angle = _norm(vector)
    if angle < 1e-12:
        return ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    x, y, z = (component / angle for component in vector)
    c, s, v = cos(angle), sin(angle), 1 - cos(angle)
    return (
        (c + x * x * v, x * y * v - z * s, x * z * v + y * s),
        (y * x * v + z * s, c + y * y * v, y * z * v - x * s),
        (z * x * v - y * s, z * y * v + x * s, c + z * z * v),
    )


def _rotation_vector(m: Matrix) -> tuple[float, ...]:
    axis = (m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1])
    angle = acos(max(-1.0, min(1.0, (m[0][0] + m[1][1] + m[2][2] - 1) / 2)))
    length = _norm(axis)
    if length > 1e-9:
        return tuple(component * angle / length for component in axis)
    if angle < 1.0:
        return (axis[0] / 2, axis[1] / 2, axis[2] / 2)
    most = max(range(3), key=lambda i: m[i][i])  # half a turn: the axis is in the symmetric part
    half = sqrt(max(0.0, (m[most][most] + 1) / 2))
    other = [half if i == most else (m[most][i] + m[i][most]) / (4 * half) for i in range(3)]
    return tuple(component * angle for component in other)


def _times(a: Matrix, b: Matrix) -> Matrix:
    return tuple(tuple(sum(a[i][k] * b[k][j] for k in range(3)) for j in range(3)) for i in range(3))


def _transposed(m: Matrix) -> Matrix:
    return tuple(tuple(m[j][i] for j in range(3)) for i in range(3))


def _norm(vector: Sequence[float]) -> float:
    return sqrt(sum(component * component for component in vector))


def _least_squares(columns: Sequence[Sequence[float]], error: Sequence[float]) -> list[float]:
    """The damped least-squares step, which is short near singularities: (J'J + damping) step = J' error."""
    rows = [[_dot(one, other) for other in columns] + [_dot(one, error)] for one in columns]
    for i, row in enumerate(rows):
        row[i] += _DAMPING
    for i in range(6):
        pivot = max(range(i, 6), key=lambda row: abs(rows[row][i]))
        rows[i], rows[pivot] = rows[pivot], rows[i]
        for below in range(i + 1, 6):
            factor = rows[below][i] / rows[i][i]
            rows[below] = [x - factor * y for x, y in zip(rows[below], rows[i], strict=True)]
    step = [0.0] * 6
    for i in reversed(range(6)):
        step[i] = (rows[i][6] - sum(rows[i][j] * step[j] for j in range(i + 1, 6))) / rows[i][i]
    return step


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    return sum(x * y for x, y in zip(a, b, strict=True))
