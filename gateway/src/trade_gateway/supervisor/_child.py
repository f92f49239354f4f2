"""A child with all that belongs to it, and what is told of it."""

import math
from collections.abc import Callable

from msgspec import Struct

from trade_gateway.config._children import Child
from trade_gateway.process._kill_timer import TimerLease, uptime_s
from trade_gateway.supervisor._lease_protocol import Leased
from trade_gateway.supervisor._objects import CreatedObjects
from trade_gateway.supervisor._process import Process
from trade_gateway.supervisor._restart_policy import Life, State

__all__ = ["ChildInfo", "News", "Unit"]


class ChildInfo(Struct, frozen=True):
    """How a child fares."""

    name: str
    state: str
    """``stopped``, ``starting``, ``up``, ``silent``, ``stopping``, ``waiting``, ``given up`` or ``elsewhere``."""
    pid: int
    """0: it has no process."""
    restarts: int
    why: str
    """Why it ended, or is ended; empty while it is up."""
    rss_mb: float = 0.0
    saved_at: float = 0.0
    """What all its objects knew then, in seconds since the epoch, is on disk; 0: nothing yet."""


class News(Struct, frozen=True):
    """Something has become of a child."""

    child: str
    state: str
    text: str
    bad: bool = False


class Unit:
    """A child with all that belongs to it; only the supervisor's thread touches it."""

    def __init__(self, child: Child, grace_s: float, clock: Callable[[], float]) -> None:
        self.child = child
        self._clock = clock
        self.life = Life(child.terms, grace_s=grace_s)
        self.process: Process | None = None
        self.boot = 0
        """Counts processes: what is told of an earlier one counts for nothing."""
        self.furnished: CreatedObjects | None = None
        self.begun = False
        self.was_up = False
        self.leaving = ""
        """Why it is not wanted any more."""
        self.save_at = math.inf
        self.saved_at = 0.0
        self.lease: Leased | None = None
        self.told: TimerLease | None = None
        """How long its process knows that it may stay."""

    @property
    def due_s(self) -> float:
        """How long until something is to be done for it."""
        now = self._clock()
        leased_s = math.inf if self.lease is None else self.lease.due - uptime_s()
        return min(self.life.deadline - now, self.save_at - now, leased_s)

    @property
    def gone(self) -> bool:
        return bool(self.leaving) and not self.life.alive

    @property
    def to_begin(self) -> bool:
        """Whether it is to be started for the first time, or since it was elsewhere."""
        return not self.begun and not self.life.alive and not self.given_up

    @property
    def elsewhere(self) -> bool:
        """Whether it has no process here as it may have none."""
        return self.lease is not None and self.to_begin

    @property
    def given_up(self) -> bool:
        """Whether only somebody who asks for it starts it again."""
        return self.life.state is State.GIVEN_UP

    def may_be_up(self) -> bool:
        """Whether no other host has it, for all that is known now."""
        if self.lease is None:
            return True
        wanted = self.life.alive or not (self.leaving or self.given_up)
        return self.lease.look(alive=self.life.alive, wanted=wanted)

    def stay(self) -> None:
        """Its process is told how long it may stay, if that is something else than before."""
        term = None if self.lease is None else self.lease.term
        if self.process is not None and term is not None and term != self.told:
            self.process.stay(term)
            self.told = term

    def info(self) -> ChildInfo:
        """How it fares."""
        lease, life = self.lease, self.life
        away = lease is not None and self.elsewhere
        return ChildInfo(
            name=self.child.name,
            state="elsewhere" if away else life.state.value,
            pid=self.process.pid if self.process else 0,
            restarts=life.restarts,
            why=lease.why if lease is not None and away else life.why or self.leaving,
            saved_at=self.saved_at,
        )
