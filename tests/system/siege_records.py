"""What planners of the siege note beyond what clients of locks do, and what is done to whom."""

from tests.holds import Ask, Done, Held, Record, Seen


class Order(Record):
    """A planner is about to have a joint moved to there."""

    number: str
    hold: str
    resource: str
    counts: int
    deadline_s: float


class Answer(Record):
    """What it was told of that."""

    number: str
    how: str


class Fault(Record):
    """Something was done, to whom, and how long it lasted."""

    what: str
    whom: str
    until: float


AnyRecord = Ask | Held | Seen | Done | Order | Answer | Fault
