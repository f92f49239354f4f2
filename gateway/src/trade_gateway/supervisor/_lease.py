"""Which of two gateways may have a container up: told what happened and when, they never say both. No I/O, no clock.

The one that stands in is the arbiter: it lets the other one have the container for so long at a time. Each counts by
its own clock, the holder from before it asked, the arbiter from when it answered, and the arbiter waits longer by more
than their clocks can differ. So whatever is lost, late or frozen in between, one of them at most has it.
"""

import math
from typing import Final

from msgspec import Struct

from trade_gateway.process._kill_timer import TimerLease

__all__ = ["Arbiter", "Holder", "Lease", "waits_s"]

DRIFT: Final = 0.025
"""Of a lease: more than two clocks differ of which each is wrong by 1 %."""
MARGIN_S: Final = 1.0
"""How long the kernel may take to end a process whose time is over."""
_LEAVES: Final = 3
"""The last third of a lease is for leaving in order."""
_ASKS: Final = 6
"""So often within a lease it is asked for anew."""


def waits_s(lease_s: float) -> float:
    """How long the arbiter waits after it gave a lease."""
    return lease_s * (1 + DRIFT) + MARGIN_S


class Lease(Struct, frozen=True):
    """What the arbiter answers."""

    turn: str
    """Names the holding that it belongs to; empty: it is refused."""
    lease_s: float = 0.0
    why: str = ""
    """It is refused."""
    states: bytes = b""
    """With a turn that the asker did not name: of the container's objects, as they were saved last."""


class Holder:
    """Asks for a lease, again and again; times are seconds of its own host's `uptime_s`.

    Args:
        now: the time.
        arbiter: its name.
    """

    def __init__(self, now: float, arbiter: str) -> None:
        self.turn = ""
        self.why = f"{arbiter} was not asked yet"
        """Why it has no lease."""
        self.term = TimerLease(-math.inf, -math.inf)
        """How long the container may stay up."""
        self.states = b""
        """What the container is to begin with, once it is held."""
        self._arbiter = arbiter
        self._ask_at = now
        self._every_s = 1.0

    def held(self, now: float) -> bool:
        """Whether the container may be up."""
        return now < self.term.leave_at

    @property
    def within_s(self) -> float:
        """How long an answer may take: no longer than two questions."""
        return 2 * self._every_s

    @property
    def due(self) -> float:
        """When to look next."""
        return min(self._ask_at, self.term.leave_at) if self.turn else self._ask_at

    def asks(self, now: float) -> bool:
        """Whether it is time to ask; the answer counts from now."""
        if now >= self.term.leave_at and self.turn:
            self.turn, self.why = "", self.why or f"{self._arbiter} does not answer"
        if now < self._ask_at:
            return False
        self._ask_at = now + self._every_s
        return True

    def answered(self, asked_at: float, turn: str, lease: Lease) -> None:
        """An answer to what was asked then, under that turn, has come."""
        if turn != self.turn:  # what it had when it asked has ended meanwhile
            return
        if not lease.turn:
            self.why = lease.why
            return
        if not turn:
            self.states = lease.states
        until = max(self.term.until, asked_at + lease.lease_s)
        self.turn, self.why, self._every_s = lease.turn, "", lease.lease_s / _ASKS
        self.term = TimerLease(until - lease.lease_s / _LEAVES, until)

    def unanswered(self, why: str) -> None:
        """A question was lost, or could not be asked."""
        self.why = why


class Arbiter:
    """Gives leases, and has the container up itself once the last one is over for certain.

    It begins as if the container were up here and were to be given back: a boot of which nothing is known any more may
    have left it behind.

    Args:
        asker: the name of the other one.
        mark: no other boot has it.
    """

    def __init__(self, asker: str, mark: str) -> None:
        self.mine = True
        """Whether it is here, or is to be, or has not ended yet."""
        self.handing = True
        """Whether it is to end here and to be given back."""
        self.turn = ""
        """Whose states count; empty: its own."""
        self.asked_at = -math.inf
        self._asker = asker
        self._free_at = math.inf
        self._mark = mark
        self._turns = 0

    @property
    def due(self) -> float:
        """When nobody else can have it any more, unless it is asked for before."""
        return math.inf if self.mine else self._free_at

    @property
    def why(self) -> str:
        """Why it is not to be here."""
        if self.handing:
            return f"it is for {self._asker} again"
        return f"{self._asker} has it" if self.turn else f"{self._asker} may have it"

    def asked(self, now: float, turn: str, lease_s: float) -> bool:
        """Whether the other one gets it for so long; then `turn` is its turn."""
        self.asked_at = now
        if self.mine:
            return False
        self._free_at = max(self._free_at, now + waits_s(lease_s))
        if not turn or turn != self.turn:
            self._turns += 1
            self.turn = f"{self._mark}.{self._turns}"
        return True

    def looked(self, now: float) -> bool:
        """Have it, if nobody else can; returns whether that has just come about."""
        if self.mine or now < self._free_at:
            return False
        self.mine, self.turn = True, ""
        return True

    def hand_back(self) -> None:
        """It is to end here; `ended` says when it has."""
        self.handing = self.mine

    def ended(self, now: float, lease_s: float) -> None:
        """It has ended here, if it was to, and is for the other one alone until a lease of so long is over."""
        if self.handing:
            self.mine = self.handing = False
            self._free_at = now + waits_s(lease_s)
