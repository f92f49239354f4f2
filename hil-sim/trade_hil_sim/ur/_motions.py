"""Motions of an arm: along a path, after a changing target, at a speed, or to rest.

Steps of a fixed time; angles in rad, times in s.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from math import copysign, sqrt
from typing import Final

from trade_hil_sim.mechanics._profile import to_position

MAX_SPEED_RAD_S: Final = 3.14159
"""The greatest speed of a joint."""
_SERVO_ACCEL_RAD_S2: Final = 40.0
"""The acceleration of a joint that follows a streamed target."""

Six = tuple[float, ...]


class Motion(ABC):
    """A motion of the joints; `done` once they are at rest and stay so."""

    done = False
    begun = True
    """False: nothing moves yet."""

    @abstractmethod
    def step(self, q: Six, qd: Six, dt: float) -> tuple[Six, Six]:
        """Angles and speeds one time step later."""


class AtRest(Motion):
    """Rest, by the brakes or by holding a position."""

    done = True

    def step(self, q: Six, qd: Six, dt: float) -> tuple[Six, Six]:  # noqa: ARG002
        """No change."""
        return q, (0.0,) * 6


class Free(AtRest):
    """Freedrive without a push: the arm stays where it is."""


class PathMotion(Motion):
    """Moves through points with a trapezoidal speed profile.

    Args:
        points: joint angles, evenly spaced along the way; the first is where it begins.
        length: of the way: in rad of the joint that turns most, or in m.
        speed: on it, per second.
        accel: on it, per second squared.
    """

    def __init__(self, points: Sequence[Six], length: float, speed: float, accel: float) -> None:
        self._points = points
        self._length = length
        self._course = to_position(0.0, 0.0, 0.0, length, max(speed, 1e-6), max(accel, 1e-6))
        self._t = 0.0

    @property
    def part(self) -> float:
        """The fraction of the path that is done, 0 to 1."""
        return self._course.at(self._t)[0] / self._length if self._length else 1.0

    def step(self, q: Six, qd: Six, dt: float) -> tuple[Six, Six]:  # noqa: ARG002
        """The position on the trapezoid now."""
        self._t += dt
        self.done = self._t >= self._course.ends
        after = self._points[-1] if self.done else self._at(self.part)
        return after, tuple((b - a) / dt for a, b in zip(q, after, strict=True)) if not self.done else (0.0,) * 6

    def _at(self, part: float) -> Six:
        along = part * (len(self._points) - 1)
        before = min(int(along), len(self._points) - 2)
        pair = zip(self._points[before], self._points[before + 1], strict=True)
        return tuple(a + (along - before) * (b - a) for a, b in pair)


class Servo(Motion):
    """Follows a target that is renewed repeatedly; otherwise holds the last one without end."""

    def __init__(self, target: Six) -> None:
        self.target = target

    def step(self, q: Six, qd: Six, dt: float) -> tuple[Six, Six]:
        """As far as speed and acceleration allow."""
        after = [self._joint(*joint, dt) for joint in zip(q, qd, self.target, strict=True)]
        return tuple(angle for angle, _ in after), tuple(speed for _, speed in after)

    @staticmethod
    def _joint(angle: float, speed: float, target: float, dt: float) -> tuple[float, float]:
        most, way = _SERVO_ACCEL_RAD_S2 * dt, target - angle
        if abs(way) <= most * dt and abs(speed) <= most:
            return target, 0.0
        # the distance of this step is no longer available for braking
        braking = sqrt(most * most / 4 + 2 * _SERVO_ACCEL_RAD_S2 * abs(way)) - most / 2
        wanted = copysign(min(MAX_SPEED_RAD_S, braking, abs(way) / dt), way)
        speed += _within(wanted - speed, most)
        return angle + speed * dt, speed


class Speed(Motion):
    """Moves at a speed, for a time or (0) without end."""

    def __init__(self, speeds: Six, accel: float, lasts_s: float) -> None:
        self._ramp = Braking(accel, speeds)
        self._left_s = lasts_s if lasts_s > 0 else float("inf")
        self.asked = (speeds, accel, lasts_s)

    def step(self, q: Six, qd: Six, dt: float) -> tuple[Six, Six]:
        """Ramp to the speed, then keep it."""
        self._left_s -= dt
        self.done = self._left_s <= 0
        return self._ramp.step(q, qd, dt)


class Braking(Motion):
    """Changes all joints to rest or other speeds in the same time; the greatest change uses this acceleration."""

    def __init__(self, accel: float, wanted: Six = (0.0,) * 6) -> None:
        self._accel = max(accel, 1e-3)
        self._wanted = wanted

    def step(self, q: Six, qd: Six, dt: float) -> tuple[Six, Six]:
        """One step nearer."""
        off = [b - a for a, b in zip(qd, self._wanted, strict=True)]
        longest = max(abs(change) for change in off)
        part = 1.0 if longest <= self._accel * dt else self._accel * dt / longest
        after = tuple(speed + part * change for speed, change in zip(qd, off, strict=True))
        if part == 1.0 and not any(self._wanted):
            self.done = True
        return tuple(a + (u + v) / 2 * dt for a, u, v in zip(q, qd, after, strict=True)), after


def _within(value: float, most: float) -> float:
    return max(-most, min(most, value))
