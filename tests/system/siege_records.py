"""What clients of the siege note beyond what clients of locks do, and what is done to whom."""

from typing import Final

from tests.support.lock_log import Ask, Done, Held, Record, Seen

CAN_BUS: Final = "leg"
"""The bus with a drive; joints of all others are servos."""


class Order(Record):
    """A client is about to have a joint moved to there."""

    number: str
    hold: str
    resource: str
    counts: int
    deadline_s: float
    valid_s: float = 0.0
    """How long it holds unless it is given again; 0: until it arrives."""


class Answer(Record):
    """The reply to that."""

    number: str
    how: str


class Fault(Record):
    """Something was done, to whom, and how long it lasted."""

    what: str
    whom: str
    until: float


class Rescue(Record):
    """A client without a link stopped a group while strangers were at the ports, or could not."""

    whom: str
    """Who was asked: ``door``, or a robot."""
    until: float
    through: bool
    said: str


class Alarm(Record):
    """A robot confirmed an e-stop before ``t``, and its clearing did not begin before ``until``."""

    robot: str
    since: float
    """When the first e-stop was given."""
    until: float


def of_robot(hold: str, robot: str) -> str:
    """A hold as far as it is of one robot."""
    return f"{hold}@{robot}"


def whole(hold: str) -> str:
    """The hold that one is a part of."""
    return hold.partition("@")[0]


AnyRecord = Ask | Held | Seen | Done | Order | Answer | Fault | Rescue | Alarm
