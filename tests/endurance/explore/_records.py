"""What is noted down in a story; times are those of its clock, in seconds."""

from typing import NamedTuple


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


class Stopped(NamedTuple):
    """A group must not move: from the report of a stop until it may be resumed."""

    what: str
    group: str
    since: float
    until: float
