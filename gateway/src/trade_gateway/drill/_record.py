"""What a drill has found, as plain records: of each scene, how long each joint went on, and how long it may."""

from typing import Any, Literal

import msgspec
from msgspec import Struct

__all__ = ["Played", "Report", "Stop", "Verdict", "as_data"]

Verdict = Literal["ok", "too long", "moved again", "did not stop"]


class Stop(Struct, frozen=True, kw_only=True):
    """How a joint came to rest in a scene."""

    joint: str
    bus: str
    took_s: float | None
    """From the deed until it rested for good; None: it was still moving when nobody waited any longer."""
    limit_s: float
    again_s: float | None = None
    """So long after the deed it moved once more, when all was mended and nobody had told it to; None: it did not."""

    @property
    def verdict(self) -> Verdict:
        """What to think of it."""
        if self.took_s is None:
            return "did not stop"
        if self.again_s is not None:
            return "moved again"
        return "ok" if self.took_s <= self.limit_s else "too long"

    @property
    def part(self) -> float:
        """How much of its limit it took; infinite if it did not stop."""
        return float("inf") if self.took_s is None else self.took_s / self.limit_s


class Played(Struct, frozen=True, kw_only=True):
    """One scene."""

    scene: str
    what: str
    shows: str
    stops: list[Stop] = []
    problems: list[str] = []
    """Why it could not be held, each time that it could not; it was in the end if there are stops."""

    @property
    def ok(self) -> bool:
        """Whether it was held, and each joint kept its limit."""
        return bool(self.stops) and all(stop.verdict == "ok" for stop in self.stops)


class Report(Struct, frozen=True, kw_only=True):
    """A whole drill."""

    robot: str
    file: str
    version: str
    host: str
    at: str
    """Date and time, ISO 8601."""
    scenes: list[Played]
    left_out: dict[str, str]
    """Parts of the robot and scenes that were not held, and why."""

    @property
    def ok(self) -> bool:
        """Whether there was a scene, and all of them were."""
        return bool(self.scenes) and all(played.ok for played in self.scenes)


def as_data(report: Report) -> dict[str, Any]:
    """The report as plain data, with what to think of it."""
    data: dict[str, Any] = msgspec.to_builtins(report)
    for played, told in zip(report.scenes, data["scenes"], strict=True):
        told["ok"] = played.ok
        for stop, row in zip(played.stops, told["stops"], strict=True):
            row["verdict"] = stop.verdict
    return {"ok": report.ok, **data}
