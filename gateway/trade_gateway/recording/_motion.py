"""The motion of joints in a recording: as measured, as a trajectory, and its deviation from another one."""

import math
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple

import msgspec

from trade.errors import ConfigurationError, LimitExceeded
from trade_drivers import JointLimits, Tolerances, Trajectory, TrajectoryPoint, planned
from trade_gateway.recording._channels import JointStates, group_of
from trade_gateway.recording._reader import entries

_decode: Final = msgspec.json.Decoder(JointStates).decode
_STEP_S: Final = 0.05
"""Time between points of a trajectory, in the recording's time, in seconds."""
_REACH_S: Final = 0.08
"""Measurements up to this time before and after a point count for it, in seconds."""
_STEPS: Final = 8
_NEAR_RAD: Final = 0.005
_INSIDE_RAD: Final = 0.002
"""Margin of the points to a limit, as the curve between points overshoots slightly."""
_NOISE: Final = 0.95
_SLOWER: Final = 0.99
_SLOWEST: Final = 0.05
_SAME_S: Final = 0.002
"""Two reads of one measurement have time stamps with a smaller difference, in seconds."""
_SET_BACK_S: Final = 1.0
"""A measurement that is older than its predecessor by more is of a clock that was set back, in seconds."""
_GAP_S: Final = 0.5
_STILL_RAD: Final = 0.02
"""A joint with a smaller change over a gap has not moved meanwhile."""
_STILL_M: Final = 0.002
"""The same for a gripper's width."""
_REST_S: Final = 0.5
"""Rest that is kept before and after the motion, in seconds."""


class Track(NamedTuple):
    """The measurements of one joint, at ascending times in seconds since the recording's first measurement."""

    times_s: Sequence[float]
    positions_rad: Sequence[float]

    def at(self, time_s: float) -> float:
        """The angle at a time, linearly interpolated."""
        times, positions = self
        after = bisect_left(times, time_s)
        if after == 0:
            return positions[0]
        if after == len(times):
            return positions[-1]
        share = (time_s - times[after - 1]) / (times[after] - times[after - 1])
        return positions[after - 1] + share * (positions[after] - positions[after - 1])

    def around(self, time_s: float) -> tuple[float, float]:
        """Angle and speed at a time, of the mean of the measurements around it, which removes noise.

        The speed is the derivative of that mean, so it never exceeds the recorded speed, nor rises earlier.
        """
        steps = [self.at(time_s + _REACH_S * (2 * step / _STEPS - 1)) for step in range(_STEPS + 1)]
        mean = (sum(steps) - (steps[0] + steps[-1]) / 2) / _STEPS
        return mean, (steps[-1] - steps[0]) / (2 * _REACH_S)


class Motion(NamedTuple):
    """The motion of a group's joints over time."""

    group: str
    joints: Sequence[str]
    tracks: Sequence[Track]
    began_s: float = 0.0
    """The time of its zero, in seconds since the epoch."""

    @property
    def duration_s(self) -> float:
        """Time from the first measurement to the last, in seconds."""
        return max(track.times_s[-1] for track in self.tracks)

    @property
    def start(self) -> list[float]:
        """The positions at its beginning."""
        return [track.around(0.0)[0] for track in self.tracks]


class Gap(NamedTuple):
    """A time in which a joint moved unmeasured, in seconds since the epoch."""

    from_s: float
    until_s: float
    joint: str


class Deviation(NamedTuple):
    """The deviation of joints from a recorded motion, in rad."""

    greatest_rad: Sequence[float]
    """For each joint, the maximum."""
    rms_rad: Sequence[float]
    """For each joint, the root mean square."""


def motions(path: Path) -> dict[str, list[JointStates]]:
    """Reads the states of joints and grippers of a recording, by group.

    Raises:
        ConfigurationError: the recording cannot be read.
    """
    found: dict[str, list[JointStates]] = {}
    for entry in entries(path):
        group = group_of(entry.topic)
        if group is not None:
            found.setdefault(group, []).append(_decode(entry.data))
    return found


def motion_of(group: str, states: Iterable[JointStates]) -> Motion:
    """Returns the motion of a group; a repeated measurement counts once.

    Raises:
        ConfigurationError: its joints change, or were not measured during a motion.
    """
    joints, measured, still = _measured(group, states)
    if not measured or any(len(track) < 3 for track in measured):
        raise ConfigurationError(where="recording", problem=f"{group} has fewer than three measurements")
    began = max(track[0][0] for track in measured)
    tracks: list[Track] = []
    for joint, track in zip(joints, measured, strict=True):
        for gap in _gaps(joint, track, still):
            at = f"from {gap.from_s - began:.1f} to {gap.until_s - began:.1f} s"
            problem = f"{joint} was not measured {at}, while it moved"
            raise ConfigurationError(where="recording", problem=problem)
        tracks.append(Track([at - began for at, _ in track], [position for _, position in track]))
    return Motion(group, joints, tracks, began)


def gaps(group: str, states: Iterable[JointStates]) -> list[Gap]:
    """Returns the times in which joints of a group moved unmeasured.

    Raises:
        ConfigurationError: its joints change.
    """
    joints, measured, still = _measured(group, states)
    return [gap for joint, track in zip(joints, measured, strict=True) for gap in _gaps(joint, track, still)]


def _measured(group: str, states: Iterable[JointStates]) -> tuple[list[str], list[list[tuple[float, float]]], float]:
    """The joints, the times and positions of their measurements, and the change of a joint at rest, in rad or m."""
    joints: list[str] = []
    measured: list[list[tuple[float, float]]] = []
    still = _STILL_RAD
    for each in states:
        joints = joints or each.names
        still = _STILL_M if each.is_gripper else _STILL_RAD
        measured = measured or [[] for _ in joints]
        if each.names != joints:
            problem = f"{group} has other joints later: {', '.join(each.names)} instead of {', '.join(joints)}"
            raise ConfigurationError(where="recording", problem=problem)
        for joint, track, at_s, position in zip(joints, measured, each.stamp_s, each.positions, strict=True):
            if track and at_s < track[-1][0] - _SET_BACK_S:
                problem = f"{joint} was measured at {at_s:.3f} s after {track[-1][0]:.3f} s: the clock was set back"
                raise ConfigurationError(where="recording", problem=f"{problem} while it was recorded. Record it again")
            if not track or at_s > track[-1][0] + _SAME_S:
                track.append((at_s, position))
    return joints, measured, still


def _gaps(joint: str, track: Sequence[tuple[float, float]], still: float) -> Iterator[Gap]:
    for (before_s, before), (after_s, after) in pairwise(track):
        if after_s - before_s > _GAP_S and abs(after - before) > still:
            yield Gap(before_s, after_s, joint)


def moving(motion: Motion) -> Motion:
    """Removes rest at both ends except for half a second; a motion without movement is unchanged."""
    leaves = [_away(track.times_s, track.positions_rad) for track in motion.tracks]
    arrives = [_away(track.times_s[::-1], track.positions_rad[::-1]) for track in motion.tracks]
    if not any(at_s is not None for at_s in leaves):
        return motion
    from_s = max(0.0, min(at_s for at_s in leaves if at_s is not None) - _REST_S)
    until_s = min(motion.duration_s, max(at_s for at_s in arrives if at_s is not None) + _REST_S)
    tracks = [_cut(track, from_s, until_s) for track in motion.tracks]
    return motion._replace(tracks=tracks, began_s=motion.began_s + from_s)


def _away(times_s: Sequence[float], positions_rad: Sequence[float]) -> float | None:
    """The last time at which a joint was at its initial angle; None: it never left it."""
    for before_s, position in zip(times_s, positions_rad[1:], strict=False):
        if abs(position - positions_rad[0]) > _STILL_RAD:
            return before_s
    return None


def _cut(track: Track, from_s: float, until_s: float) -> Track:
    inside = [(at_s, place) for at_s, place in zip(*track, strict=True) if from_s < at_s < until_s]
    places = [(from_s, track.at(from_s)), *inside, (until_s, track.at(until_s))]
    return Track([at_s - from_s for at_s, _ in places], [place for _, place in places])


def fitted(motion: Motion, speed: float, limits: Sequence[JointLimits]) -> tuple[Trajectory, float]:
    """Returns the motion as a trajectory within the limits, and its speed: as requested, or up to 5 % less.

    Measurements at a limit are as often beyond it as not.

    Raises:
        LimitExceeded: it exceeds the limits even so; the error names the speed at which it would not, if there is one.
    """
    refused: LimitExceeded | None = None
    slower = speed
    while slower >= _SLOWEST:
        way = trajectory(motion, slower, limits)
        try:
            planned(way, Tolerances(), limits)
        except LimitExceeded as problem:
            refused = refused or problem
        else:
            if refused is None or slower >= speed * _NOISE:
                return way, slower
            what = f"{refused.what} (with --speed {math.floor(slower * 100) / 100:.2f} it keeps the limits)"
            raise LimitExceeded(
                what=what, value=refused.value, lower=refused.lower, upper=refused.upper, unit=refused.unit
            )
        if refused.unit == "rad":  # no speed helps
            raise refused
        slower *= _SLOWER
    assert refused is not None  # noqa: S101 - the loop ran
    raise refused


def trajectory(motion: Motion, speed: float, limits: Sequence[JointLimits] = ()) -> Trajectory:
    """Returns the motion as points over time, at rest at both ends, with noise removed.

    Args:
        motion: the recorded motion.
        speed: 1 is the recorded speed; 0.5 takes twice as long.
        limits: angles less than 5 mrad beyond them are set to 2 mrad inside.
    """
    ranges = {limit.name: (limit.min_rad, limit.max_rad) for limit in limits}
    count = max(2, round(motion.duration_s / _STEP_S))
    step_s = motion.duration_s / count
    points: list[TrajectoryPoint] = []
    for number in range(count + 1):
        places = [track.around(number * step_s) for track in motion.tracks]
        still = number in (0, count)
        points.append(
            TrajectoryPoint(
                time_from_start_s=number * step_s / speed,
                positions_rad=[
                    _inside(position, ranges.get(joint))
                    for joint, (position, _) in zip(motion.joints, places, strict=True)
                ],
                velocities_rad_s=[0.0 if still else velocity * speed for _, velocity in places],
            )
        )
    return Trajectory(joints=list(motion.joints), points=points)


def _inside(position_rad: float, ends: tuple[float, float] | None) -> float:
    if ends is None:
        return position_rad
    off = min(_INSIDE_RAD, (ends[1] - ends[0]) / 4)
    inside = min(max(position_rad, ends[0] + off), ends[1] - off)
    return inside if abs(inside - position_rad) < _NEAR_RAD + off else position_rad


def deviation(motion: Motion, speed: float, measured: Motion, latest_s: float = 2.0) -> tuple[Deviation, float]:
    """Compares a measured motion with a recorded one, at the delay with the best fit.

    Args:
        motion: the recorded motion.
        speed: the speed of its replay.
        measured: the same joints, from before the beginning to after the end.
        latest_s: the greatest possible delay in seconds.

    Returns:
        The deviation, and the delay in seconds from the first measurement to the beginning.
    """
    coarse = [latest_s * step / 100 for step in range(101)]
    best = min(coarse, key=lambda delay: _misfit(motion, speed, measured, delay))
    fine = [best + latest_s * step / 2000 for step in range(-20, 21)]
    best = min(fine, key=lambda delay: _misfit(motion, speed, measured, delay))
    errors = _errors(motion, speed, measured, best, 1)
    greatest = [max(map(abs, each), default=0.0) for each in errors]
    rms = [math.sqrt(sum(error * error for error in each) / max(1, len(each))) for each in errors]
    return Deviation(greatest, rms), best


def _misfit(motion: Motion, speed: float, measured: Motion, delay_s: float) -> float:
    every = max(1, len(measured.tracks[0].times_s) // 400)
    return sum(error * error for each in _errors(motion, speed, measured, delay_s, every) for error in each)


def _errors(motion: Motion, speed: float, measured: Motion, delay_s: float, every: int) -> list[list[float]]:
    """For each joint, at every measurement or every nth: measured minus recorded."""
    tracks = dict(zip(measured.joints, measured.tracks, strict=True))
    return [
        [
            position - track.at((at_s - delay_s) * speed)
            for at_s, position in list(zip(*tracks[joint], strict=True))[::every]
        ]
        for joint, track in zip(motion.joints, motion.tracks, strict=True)
    ]
