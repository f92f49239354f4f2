"""A plan: checked curves for some joints, handed to the driver; all buses that execute it share its course."""

import threading
from collections.abc import Sequence
from typing import NamedTuple

from msgspec import Struct

from trade import progress
from trade_drivers.motion._spline import Curve


class JointLimits(Struct, frozen=True, kw_only=True):
    """The limits for commands to a joint, from the robot file."""

    name: str
    min_rad: float
    max_rad: float
    max_speed_rad_s: float
    max_accel_rad_s2: float


class Tolerances(Struct, frozen=True, kw_only=True):
    """How far each joint may be from its trajectory; all values are above zero."""

    start_rad: float = 0.05
    """Distance from the first point at the start."""
    path_rad: float = 0.2
    """Distance from the current set-point on the way."""
    goal_rad: float = 0.03
    """Distance from the last point, at rest."""
    goal_time_s: float = 0.5
    """Time allowed after the last point to come to rest there."""


class FollowProgress(Struct, frozen=True, kw_only=True):
    """Progress of a trajectory, as ``run.progress()`` of a ``follow`` returns it several times a second."""

    fraction: float
    """Fraction of the duration, 0 to 1."""
    errors_rad: list[float]
    """Measured position minus the set-point of that time, for each joint in the order of ``joints()``."""


class Course:
    """The execution of one plan: its start, its progress, and the error that ended it on all its buses.

    The threads of several buses write to it, each the errors of its own joints.
    """

    def __init__(self, joints: Sequence[str], duration_s: float) -> None:
        self.duration_s = duration_s
        self.failed: BaseException | None = None
        """The error that ended the plan on all buses."""
        self._errors_rad = dict.fromkeys(joints, 0.0)
        self._lock = threading.Lock()
        self._awaited = 1
        self._began_ns: int | None = None

    def split(self, parts: int) -> None:
        """Sets the number of buses that execute the plan; it starts when all of them are ready."""
        self._awaited = parts

    def ready(self, now_ns: int) -> None:
        """Reports that one bus is ready to start; the last one starts the clock."""
        with self._lock:
            self._awaited -= 1
            if self._awaited == 0:
                self._began_ns = now_ns

    def elapsed_s(self, at_ns: int) -> float:
        """Returns the seconds since the start; negative before it."""
        return -1.0 if self._began_ns is None else (at_ns - self._began_ns) / 1e9

    def fail(self, error: BaseException) -> None:
        """Ends the plan on all buses; the first error counts."""
        with self._lock:
            self.failed = self.failed or error

    def note(self, joint: str, error_rad: float) -> None:
        """Records how far a joint is from its set-point."""
        self._errors_rad[joint] = error_rad

    def report(self, now_ns: int) -> None:
        """Reports the progress to the caller."""
        fraction = max(0.0, min(1.0, self.elapsed_s(now_ns) / self.duration_s))
        progress(FollowProgress(fraction=fraction, errors_rad=list(self._errors_rad.values())))


class Track(NamedTuple):
    """One joint's part of a plan."""

    limits: JointLimits
    curve: Curve


class Plan(NamedTuple):
    """Checked curves for the joints of a group, in its order, all of one duration."""

    tracks: Sequence[Track]
    tolerances: Tolerances
    course: Course

    def of(self, joints: Sequence[str]) -> "Plan":
        """Returns the part of the plan for some of its joints, in their order, with the same course."""
        tracks = {track.limits.name: track for track in self.tracks}
        return Plan([tracks[joint] for joint in joints], self.tolerances, self.course)
