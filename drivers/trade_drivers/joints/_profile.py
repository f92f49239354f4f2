"""Trapezoidal profiles for joints that start and arrive together, in the device's counts."""

from collections.abc import Sequence
from math import sqrt
from typing import NamedTuple

from trade_drivers.joints._axis import Resolution


class Leg(NamedTuple):
    """One joint's distance, with its maximum speed and acceleration."""

    distance_counts: int
    speed_counts: int
    accel_counts: int
    resolution: Resolution


class Profile(NamedTuple):
    """The values of a device's profile registers, and the resulting duration."""

    accel_counts: int
    speed_counts: int
    duration_s: float


def together(legs: Sequence[Leg]) -> list[Profile]:
    """Returns profiles with which all legs end together with the slowest one, within their own limits.

    Each is the leg's own fastest trapezoid, stretched in time. 0 is never used, since devices take it for "no limit".
    """
    duration_s = max(_duration_s(leg, leg.speed_counts, leg.accel_counts) for leg in legs)
    return [_stretched(leg, duration_s) for leg in legs]


def _duration_s(leg: Leg, speed_counts: int, accel_counts: int) -> float:
    distance, speed = abs(leg.distance_counts) * leg.resolution.rad, speed_counts * leg.resolution.rad_s
    accel = accel_counts * leg.resolution.rad_s2
    if distance < speed * speed / accel:
        return 2 * sqrt(distance / accel)
    return distance / speed + speed / accel


def _stretched(leg: Leg, duration_s: float) -> Profile:
    fastest_s = _duration_s(leg, leg.speed_counts, leg.accel_counts)
    ratio = fastest_s / duration_s if duration_s > 0 else 1.0
    best: Profile | None = None
    ideal = leg.speed_counts * ratio
    for speed in {max(1, int(ideal)), min(leg.speed_counts, int(ideal) + 1)}:
        accel = _accel_for(leg, speed, duration_s, leg.accel_counts * ratio * ratio)
        profile = Profile(accel, speed, _duration_s(leg, speed, accel))
        if best is None or abs(profile.duration_s - duration_s) < abs(best.duration_s - duration_s):
            best = profile
    assert best is not None  # noqa: S101 - the set above has one or two members
    return best


def _accel_for(leg: Leg, speed: int, duration_s: float, ideal: float) -> int:
    """Returns the acceleration that compensates for the rounded speed, within the limit."""
    cruise_s = abs(leg.distance_counts) * leg.resolution.rad / (speed * leg.resolution.rad_s)
    if 0 < cruise_s < duration_s:
        exact = speed * leg.resolution.rad_s / (duration_s - cruise_s) / leg.resolution.rad_s2
        # only a profile that reaches its speed is a trapezoid; otherwise the triangle's acceleration is right
        ideal = exact if cruise_s >= duration_s / 2 else ideal
    return max(1, min(leg.accel_counts, round(ideal)))
