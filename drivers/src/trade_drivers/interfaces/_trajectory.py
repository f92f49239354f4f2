"""Trajectories, and their validation before anything is sent."""

from collections.abc import Sequence
from itertools import pairwise
from math import inf

from msgspec import Struct

from trade import current_call
from trade.errors import InvalidArgument, LimitExceeded
from trade_drivers._validation import finite, one_each
from trade_drivers.motion._plan import Course, JointLimits, Plan, Tolerances, Track
from trade_drivers.motion._spline import Curve

__all__ = ["Trajectory", "TrajectoryPoint", "checked", "planned"]

_ROUNDING = 1e-6


class TrajectoryPoint(Struct, frozen=True, kw_only=True):
    """The positions of all joints at one time."""

    time_from_start_s: float
    """0 at the first point; increases from point to point."""
    positions_rad: list[float]
    """In the order of the trajectory's ``joints``."""
    velocities_rad_s: list[float] | None = None
    """In the same order; given at all points or at none."""


class Trajectory(Struct, frozen=True, kw_only=True):
    """Angles over time.

    Between two points, each joint follows the cubic curve with the angles and speeds of both. Without velocities, the
    trajectory begins and ends at rest, and the driver chooses intermediate speeds so that no point is overshot.
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
    tracks: list[Track] = []
    for column, limit in zip(order, limits, strict=True):
        speeds = None if velocities is None else [row[column] for row in velocities]
        tracks.append(Track(limit, Curve.through(times, [row[column] for row in positions], speeds)))
    _tolerable(tolerances, service)
    _in_time(times[-1], service)
    return checked(tracks, tolerances)


def checked(tracks: Sequence[Track], tolerances: Tolerances) -> Plan:
    """Returns a plan after checking that its tracks keep the limits of their joints.

    A track may begin outside its joint's range if it moves back inside and never further out.

    Raises:
        LimitExceeded: a track exceeds a limit.
    """
    for limits, curve in tracks:
        ends = (limits.min_rad, limits.max_rad)
        start, goal = curve.at(0)[0], curve.at(inf)[0]
        _keep(limits.name, "angle", "rad", [(curve.duration_s, goal)], *ends)
        _keep(limits.name, "angle", "rad", _each(curve, "angles"), min(start, ends[0]), max(start, ends[1]))
        speed, accel = limits.max_speed_rad_s, limits.max_accel_rad_s2
        _keep(limits.name, "speed", "rad/s", _each(curve, "speeds"), -speed, speed)
        _keep(limits.name, "acceleration", "rad/s2", _each(curve, "accels"), -accel, accel)
    return Plan(tracks, tolerances, Course([limits.name for limits, _ in tracks], tracks[0].curve.duration_s))


def _each(curve: Curve, what: str) -> list[tuple[float, float]]:
    return [(piece.begins_s, value) for piece in curve.pieces for value in getattr(piece, what)()]


def _keep(joint: str, what: str, unit: str, values: Sequence[tuple[float, float]], lower: float, upper: float) -> None:
    slack = _ROUNDING * max(1.0, upper - lower)
    for time_s, value in values:
        if not lower - slack <= value <= upper + slack:
            where = f"{joint} {what} from {time_s:.4g} s on"
            raise LimitExceeded(what=where, value=value, lower=lower, upper=upper, unit=unit)


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
    elif times[0] != 0:
        problem = f"the first is {times[0]:g}; it must be 0, at the current position of the joints"
    else:
        late = [(before, after) for before, after in pairwise(times) if not after > before]
        problem = f"{late[0][1]:g} comes after {late[0][0]:g}; times must increase" if late else ""
    if problem:
        raise InvalidArgument(service=service, argument=argument, problem=problem)
    return times


def _velocities(trajectory: Trajectory, service: str) -> list[list[float]] | None:
    argument = "trajectory.velocities_rad_s"
    given = [point.velocities_rad_s for point in trajectory.points]
    rows = [one_each(row, trajectory.joints, service, argument) for row in given if row is not None]
    if not rows:
        return None
    problem = ""
    if len(rows) < len(given):
        problem = f"{len(rows)} of {len(given)} points have velocities; give them at all points or at none"
    elif any(rows[-1]):
        problem = f"the last velocities are {rows[-1]}; a trajectory must end at rest"
    if problem:
        raise InvalidArgument(service=service, argument=argument, problem=problem)
    return rows


def _tolerable(tolerances: Tolerances, service: str) -> None:
    for name in tolerances.__struct_fields__:
        if finite(getattr(tolerances, name), service, f"tolerances.{name}") <= 0:
            problem = f"{getattr(tolerances, name):g} is not above 0"
            raise InvalidArgument(service=service, argument=f"tolerances.{name}", problem=problem)


def _in_time(duration_s: float, service: str) -> None:
    call = current_call()
    left_s = None if call is None else call.remaining_s
    if left_s is not None and duration_s >= left_s:
        problem = f"lasts {duration_s:.3g} s, but its call has {left_s:.3g} s left; with_(deadline_s=...) gives it more"
        raise InvalidArgument(service=service, argument="trajectory", problem=problem)
