"""A plan: checked curves for some joints, handed to the driver; its course is shared by all buses that carry it out."""

import threading
from collections.abc import Sequence
from typing import Final, NamedTuple

from msgspec import Struct

from trade import progress
from trade_drivers.motion._spline import Curve

__all__ = ["Course", "FollowProgress", "JointLimits", "Plan", "Tolerances", "Track"]

_LEAD_NS: Final = 50_000_000
"""From the moment the last of several buses is ready to the beginning: each of them has its next cycle by then."""


class JointLimits(Struct, frozen=True, kw_only=True):
    """What a joint may be told, from the robot file."""

    name: str
    min_rad: float
    max_rad: float
    max_speed_rad_s: float
    max_accel_rad_s2: float


class Tolerances(Struct, frozen=True, kw_only=True):
    """How far any joint may be from its trajectory; all above zero."""

    start_rad: float = 0.05
    """From the first point, when it begins."""
    path_rad: float = 0.2
    """From where it should be at each moment on the way."""
    goal_rad: float = 0.03
    """From the last point, at rest."""
    goal_time_s: float = 0.5
    """How long after its last point's time it may come to rest there."""


class FollowProgress(Struct, frozen=True, kw_only=True):
    """How far a trajectory is: what ``run.progress()`` of a ``follow`` gives, several times a second."""

    fraction: float
    """Of its duration, 0 to 1."""
    errors_rad: list[float]
    """Where each joint was measured minus where it should have been then; in the order of ``joints()``."""


class Course:
    """One plan's way through time: when it begins, how it is coming along, and what ended it for all of its buses.

    The threads of several buses write to it, each the errors of its own joints.
    """

    def __init__(self, joints: Sequence[str], duration_s: float) -> None:
        self.duration_s = duration_s
        self.failed: BaseException | None = None
        """Why no bus may go on with it."""
        self._errors_rad = dict.fromkeys(joints, 0.0)
        self._lock = threading.Lock()
        self._parts = self._awaited = 1
        self._began_ns: int | None = None

    def split(self, parts: int) -> None:
        """It is carried out by so many buses; it begins when all of them are ready."""
        self._parts = self._awaited = parts

    def ready(self, now_ns: int) -> None:
        """One bus stands at the beginning; with the last of them the time begins to count."""
        with self._lock:
            self._awaited -= 1
            if self._awaited == 0:
                self._began_ns = now_ns + (_LEAD_NS if self._parts > 1 else 0)

    def elapsed_s(self, at_ns: int) -> float:
        """Seconds since it began; below zero before that."""
        return -1.0 if self._began_ns is None else (at_ns - self._began_ns) / 1e9

    def fail(self, error: BaseException) -> None:
        """End it on every bus; the first error is the one that counts."""
        with self._lock:
            self.failed = self.failed or error

    def note(self, joint: str, error_rad: float) -> None:
        """How far a joint is from where it should be."""
        self._errors_rad[joint] = error_rad

    def report(self, now_ns: int) -> None:
        """Tell the caller how far it is."""
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
        """The part of it for some of its joints, in their order; the course is the same."""
        tracks = {track.limits.name: track for track in self.tracks}
        return Plan([tracks[joint] for joint in joints], self.tolerances, self.course)
