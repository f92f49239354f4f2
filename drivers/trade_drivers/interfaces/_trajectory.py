"""Trajectories, and their validation before anything is sent."""

from collections.abc import Sequence
from itertools import pairwise
from math import inf

from msgspec import Struct

from trade import current_call
from trade.errors import InvalidArgument, LimitExceeded
from trade_drivers._validation import finite, one_each
from trade_drivers.motion._plan import Course, JointLimits, Plan, Tolerances, Track
from trade_drivers.motion._ramps import RampSegment
from trade_drivers.motion._spline import CubicSegment, Curve, cubic

_ROUNDING = 1e-6
_AT_ONCE_S = 1e-3
"""A first time below this is rounding of 0."""
_STEP_S = 0.99e-9
"""The least time between two points: 1 ns, to rounding, as in ROS."""
_REST_RAD_S = 1e-3
"""A last velocity up to this is rest, as no joint resolves it."""


class TrajectoryPoint(Struct, frozen=True, kw_only=True):
    """The positions of all joints at one time."""

    time_from_start_s: float
    """0 at the first point, to less than a millisecond; increases from point to point."""
    positions_rad: list[float]
    """In the order of the trajectory's ``joints``."""
    velocities_rad_s: list[float] | None = None
    """In the same order; given at all points or at none. The last ones are 0, to 1e-3 rad/s."""
    accelerations_rad_s2: list[float] | None = None
    """In the same order; given at any points. They must keep the limits; the curve follows from the rest."""


class Trajectory(Struct, frozen=True, kw_only=True):
    """Angles over time.

    Between two points, each joint follows the cubic curve with the angles and speeds of both. If that curve breaks a
    limit, the joint follows the motion with ramps at its full acceleration around a cruise, if there is one. Without
    velocities, the trajectory begins and ends at rest, and the driver chooses intermediate speeds so that no point is
    overshot; then all pieces are cubic.
    """

    joints: list[str]
    """Full names (``rosie.neck.pan``) of all joints of the group, in any order."""
    points: list[TrajectoryPoint]
    """At least two points. The first is the current position of the joints; the last is at rest."""


def planned(trajectory: Trajectory, tolerances: Tolerances, limits: Sequence[JointLimits]) -> Plan:
    """Returns the plan of a trajectory, with its joints in the order of the limits.

    Raises:
        InvalidArgument: the trajectory is not valid for these joints, or lasts beyond the deadline of the call.
        LimitExceeded: an angle, speed or acceleration is outside its joint's limits.
    """
    call = current_call()
    service = "follow" if call is None else call.service
    order = _order(trajectory, [limit.name for limit in limits], service)
    times = _times(trajectory, service)
    positions = [
        one_each(point.positions_rad, trajectory.joints, service, "trajectory.positions_rad")
        for point in trajectory.points
    ]
    velocities = _velocities(trajectory, service)
    accelerations = _accelerations(trajectory, service)
    tracks: list[Track] = []
    for column, limit in zip(order, limits, strict=True):
        accels = [(time_s, row[column]) for time_s, row in accelerations]
        _keep(limit.name, "acceleration", "rad/s2", accels, -limit.max_accel_rad_s2, limit.max_accel_rad_s2)
        angles = [row[column] for row in positions]
        if velocities is None:
            tracks.append(Track(limit, Curve.through(times, angles)))
        else:
            tracks.append(Track(limit, _curve(limit, times, angles, [row[column] for row in velocities])))
    _tolerable(tolerances, service)
    _in_time(times[-1], service)
    return checked(tracks, tolerances)


def _curve(
    limits: JointLimits, times_s: Sequence[float], angles_rad: Sequence[float], speeds_rad_s: Sequence[float]
) -> Curve:
    """Returns a curve through points with speeds; where the cubic piece would break a limit, the motion is ramped.

    Raises:
        LimitExceeded: a point exceeds a limit, or no motion between two points keeps those of speed and acceleration.
    """
    speed, accel = limits.max_speed_rad_s, limits.max_accel_rad_s2
    low, high = _range(limits, angles_rad[0])
    _keep(limits.name, "angle", "rad", list(zip(times_s, angles_rad, strict=True)), low, high)
    _keep(limits.name, "speed", "rad/s", list(zip(times_s, speeds_rad_s, strict=True)), -speed, speed)
    speed = max(speed, *map(abs, speeds_rad_s))  # they exceed it by no more than rounding
    pieces: list[CubicSegment] = []
    for (begins_s, start, before), (ends_s, end, after) in pairwise(
        zip(times_s, angles_rad, speeds_rad_s, strict=True)
    ):
        piece = cubic(begins_s, start, ends_s, end, before, after)
        if _keeps(limits, piece, angles_rad[0]):
            pieces.append(piece)
            continue
        passage = RampSegment(begins_s, ends_s - begins_s, start, end, before, after)
        if (ramped := passage.ramped(speed, accel)) is None:
            if abs(mean := passage.mean_rad_s) > speed:
                raise _beyond(limits.name, "speed", "rad/s", begins_s, mean, -speed, speed)
            needed = passage.least_accel_rad_s2(speed)
            raise _beyond(limits.name, "acceleration", "rad/s2", begins_s, needed, -accel, accel)
        pieces += ramped
    return Curve(pieces)


def _keeps(limits: JointLimits, piece: CubicSegment, start_rad: float) -> bool:
    try:
        _within(limits, [piece], start_rad)
    except LimitExceeded:
        return False
    return True


def checked(tracks: Sequence[Track], tolerances: Tolerances) -> Plan:
    """Returns a plan after checking that its tracks keep the limits of their joints.

    A track may begin outside its joint's range if it moves back inside and never further out.

    Raises:
        LimitExceeded: a track exceeds a limit.
    """
    for limits, curve in tracks:
        goal = curve.at(inf)[0]
        _keep(limits.name, "angle", "rad", [(curve.duration_s, goal)], limits.min_rad, limits.max_rad)
        _within(limits, curve.pieces, curve.at(0)[0])
    return Plan(tracks, tolerances, Course([limits.name for limits, _ in tracks], tracks[0].curve.duration_s))


def _within(limits: JointLimits, pieces: Sequence[CubicSegment], start_rad: float) -> None:
    """Raises ``LimitExceeded`` if pieces exceed a limit; the range includes the start of the motion."""
    low, high = _range(limits, start_rad)
    speed, accel = limits.max_speed_rad_s, limits.max_accel_rad_s2
    angles = [(piece.begins_s, each) for piece in pieces for each in piece.angles()]
    _keep(limits.name, "angle", "rad", angles, low, high)
    speeds = [(piece.begins_s, each) for piece in pieces for each in piece.speeds()]
    _keep(limits.name, "speed", "rad/s", speeds, -speed, speed)
    accels = [(piece.begins_s, each) for piece in pieces for each in piece.accels()]
    _keep(limits.name, "acceleration", "rad/s2", accels, -accel, accel)


def _range(limits: JointLimits, start_rad: float) -> tuple[float, float]:
    return min(start_rad, limits.min_rad), max(start_rad, limits.max_rad)


def _keep(joint: str, what: str, unit: str, values: Sequence[tuple[float, float]], lower: float, upper: float) -> None:
    slack = _ROUNDING * max(1.0, upper - lower)
    for time_s, value in values:
        if not lower - slack <= value <= upper + slack:
            raise _beyond(joint, what, unit, time_s, value, lower, upper)


def _beyond(joint: str, what: str, unit: str, time_s: float, value: float, lower: float, upper: float) -> LimitExceeded:
    where = f"{joint} {what} from {time_s:.4g} s on"
    return LimitExceeded(what=where, value=value, lower=lower, upper=upper, unit=unit)


def _order(trajectory: Trajectory, joints: Sequence[str], service: str) -> list[int]:
    if sorted(trajectory.joints) != sorted(joints):
        problem = f"is for {', '.join(trajectory.joints) or 'no joints'}; it must be for {', '.join(joints)}"
        raise InvalidArgument(service=service, argument="trajectory.joints", problem=problem)
    return [trajectory.joints.index(joint) for joint in joints]


def _times(trajectory: Trajectory, service: str) -> list[float]:
    argument = "trajectory.time_from_start_s"
    times = [finite(point.time_from_start_s, service, argument) for point in trajectory.points]
    problem = ""
    if len(times) < 2:
        problem = f"there are {len(times)} points; a trajectory has at least two"
    elif abs(times[0]) >= _AT_ONCE_S:
        problem = f"the first is {times[0]:g}; it must be 0, at the current position of the joints"
    else:
        late = [(before, after) for before, after in pairwise(times) if after - before < _STEP_S]
        problem = f"{late[0][1]:g} comes after {late[0][0]:g}; times must increase, by 1 ns at least" if late else ""
    if problem:
        raise InvalidArgument(service=service, argument=argument, problem=problem)
    return [time_s - times[0] for time_s in times]


def _velocities(trajectory: Trajectory, service: str) -> list[list[float]] | None:
    argument = "trajectory.velocities_rad_s"
    given = [point.velocities_rad_s for point in trajectory.points]
    rows = [one_each(row, trajectory.joints, service, argument) for row in given if row is not None]
    if not rows:
        return None
    problem = ""
    if len(rows) < len(given):
        problem = f"{len(rows)} of {len(given)} points have velocities; give them at all points or at none"
    elif moving := [each for each in zip(trajectory.joints, rows[-1], strict=True) if abs(each[1]) > _REST_RAD_S]:
        joint, speed = moving[0]
        problem = f"{joint} still has {speed:g} rad/s at the last point; a trajectory must end at rest (0)"
    if problem:
        raise InvalidArgument(service=service, argument=argument, problem=problem)
    return rows


def _accelerations(trajectory: Trajectory, service: str) -> list[tuple[float, list[float]]]:
    """Returns the time and the accelerations of each point that has some."""
    return [
        (
            point.time_from_start_s,
            one_each(point.accelerations_rad_s2, trajectory.joints, service, "trajectory.accelerations_rad_s2"),
        )
        for point in trajectory.points
        if point.accelerations_rad_s2 is not None
    ]


def _tolerable(tolerances: Tolerances, service: str) -> None:
    for name in tolerances.__struct_fields__:
        if finite(getattr(tolerances, name), service, f"tolerances.{name}") <= 0:
            problem = f"{getattr(tolerances, name):g} is not above 0"
            raise InvalidArgument(service=service, argument=f"tolerances.{name}", problem=problem)


def _in_time(duration_s: float, service: str) -> None:
    call = current_call()
    left_s = None if call is None else call.remaining_s
    if left_s is not None and duration_s >= left_s:
        problem = f"lasts {duration_s:.3g} s, but its call has {left_s:.3g} s left"
        raise InvalidArgument(service=service, argument="trajectory", problem=problem, late=True)
