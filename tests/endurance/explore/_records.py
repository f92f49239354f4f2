"""What is noted down in a story; times are those of its clock, in seconds."""

from math import inf
from typing import NamedTuple

from tests.endurance.explore._robots import RobotKind


class Held(NamedTuple):
    """A client surely held the lock of a group."""

    client: str
    group: str
    since: float
    until: float


class Moved(NamedTuple):
    """A client's call that may move a group was under way, from its start until its client knew its end."""

    client: str
    group: str
    since: float
    until: float
    how: str
    """The name of its error; empty: it was done."""
    lasts_s: float
    """How long what it started may move after it."""


class Stopped(NamedTuple):
    """A group must not move: from the report of a stop, or of a broken lock, until it may be moved again."""

    what: str
    group: str
    since: float
    until: float
    rests_s: float = 0.0
    """How long it may brake after the report."""
    freed: float = inf
    """From when on a client may lock and move it again."""


class Drawn(NamedTuple):
    """A trouble of a story, at a robot."""

    at_s: float
    name: str
    kind: RobotKind
    number: int = 0

    def __str__(self) -> str:
        return f"{self.number} {self.name} at {self.at_s:.2f} s"
