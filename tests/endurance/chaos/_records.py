"""What every process of the chaos notes down as it happens, beyond what clients of locks do."""

from tests.support.lock_log import Ask, Done, Held, Record, Seen


class Command(Record):
    """The gate let a command through; the time is that before it was asked."""

    epoch: str
    resource: str
    hold: str
    grants: tuple[int, ...]
    """Of this container, shown by the call."""


class Byte(Record):
    """One byte on the wire, of the command of that time."""

    epoch: str
    resource: str
    hold: str
    command_t: float


class Grant(Record):
    """The table has granted."""

    epoch: str
    number: int
    resources: tuple[str, ...]
    lease_s: float


class Renewed(Record):
    """Leases began again."""

    epoch: str
    numbers: tuple[int, ...]


class End(Record):
    """A grant holds no more; the time is that before it ended."""

    epoch: str
    number: int
    after_t: float


class Beat(Record):
    """The driver's process runs; what lies further apart than it should is time it did not have."""

    epoch: str


class Fault(Record):
    """Something was done to a process."""

    what: str
    process: str


AnyRecord = Ask | Held | Seen | Done | Command | Byte | Grant | Renewed | End | Beat | Fault
