"""A supervised child, and the reports about it."""

import math
from collections.abc import Callable

from msgspec import Struct

from trade_gateway.config._children import Child
from trade_gateway.process._kill_timer import TimerLease, uptime_s
from trade_gateway.supervisor._lease_protocol import LeaseEnd
from trade_gateway.supervisor._objects import CreatedObjects
from trade_gateway.supervisor._process import Process
from trade_gateway.supervisor._restart_policy import ChildLife, State


class ChildInfo(Struct, frozen=True):
    """The state of a child."""

    name: str
    state: str
    """``stopped``, ``starting``, ``up``, ``silent``, ``stopping``, ``waiting``, ``given up`` or ``elsewhere``."""
    pid: int
    """The process id; 0 without a process."""
    restarts: int
    why: str
    """Why it ended or is being ended; empty while it is up."""
    rss_mb: float = 0.0
    absent: bool = False
    """Whether it waits for a device that does not answer yet."""
    saved_at: float = 0.0
    """When the state of all its objects was last saved, in seconds since the Unix epoch; 0: not yet."""


class News(Struct, frozen=True):
    """A report about a child."""

    child: str
    state: str
    text: str
    bad: bool = False


class Unit:
    """A child with its process and policy; used only by the supervisor's thread."""

    def __init__(self, child: Child, grace_s: float, clock: Callable[[], float]) -> None:
        self.child = child
        self._clock = clock
        self.life = ChildLife(child.terms, grace_s=grace_s)
        self.process: Process | None = None
        self.boot = 0
        """Counts processes, so that reports about an earlier one are ignored."""
        self.before: frozenset[str] = frozenset()
        """Boots of the container that its program announces, seen before its process was started."""
        self.furnished: CreatedObjects | None = None
        self.begun = False
        self.was_up = False
        self.leaving = ""
        """The reason for its requested end; empty if none is requested."""
        self.save_at = math.inf
        self.saved_at = 0.0
        self.lease: LeaseEnd | None = None
        self.sent: TimerLease | None = None
        """The lease that its process has received."""

    @property
    def due_s(self) -> float:
        """The time until its next action, in seconds."""
        now = self._clock()
        leased_s = math.inf if self.lease is None else self.lease.due - uptime_s()
        return min(self.life.deadline - now, self.save_at - now, leased_s)

    @property
    def has_ended(self) -> bool:
        return bool(self.leaving) and not self.life.alive

    @property
    def to_begin(self) -> bool:
        """Whether it has to be started: for the first time, or again after it ran elsewhere."""
        return not self.begun and not self.life.alive and not self.given_up

    @property
    def elsewhere(self) -> bool:
        """Whether it has no process here because it has no lease."""
        return self.lease is not None and self.to_begin

    @property
    def given_up(self) -> bool:
        """Whether only an explicit request restarts it."""
        return self.life.state is State.GIVEN_UP

    def may_be_up(self) -> bool:
        """Whether it may run here: without a lease always, else while it has one."""
        if self.lease is None:
            return True
        wanted = self.life.alive or not (self.leaving or self.given_up)
        return self.lease.update(alive=self.life.alive, wanted=wanted)

    def send_lease(self) -> None:
        """Sends its process a changed lease."""
        term = None if self.lease is None else self.lease.term
        if self.process is not None and term is not None and term != self.sent:
            self.process.send_lease(term)
            self.sent = term

    def info(self) -> ChildInfo:
        """Returns its state."""
        lease, life = self.lease, self.life
        away = lease is not None and self.elsewhere
        return ChildInfo(
            name=self.child.name,
            state="elsewhere" if away else life.state.value,
            pid=self.process.pid if self.process else 0,
            restarts=life.restarts,
            why=lease.why if lease is not None and away else life.why or self.leaving,
            absent=life.absences > 0,
            saved_at=self.saved_at,
        )
