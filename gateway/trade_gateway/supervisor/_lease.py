"""The lease protocol: which of several gateways may run a container. At most one may at any time. No I/O, no clock.

The standby gateway is the arbiter. It leases the container to another one, the holder, for a limited time. Each uses
its own clock: the holder counts from before its request, the arbiter from its answer, and the arbiter waits longer by
more than their clocks can differ. So at most one has the container, whatever message is lost, late or frozen. Another
gateway gets a lease only when the holder's has certainly expired.
"""

import math
from collections.abc import Sequence
from typing import Final

from msgspec import Struct

from trade_gateway.process._kill_timer import TimerLease

DRIFT: Final = 0.025
"""Share of a lease; more than the difference of two clocks with an error of 1 % each."""
MARGIN_S: Final = 1.0
"""How long the kernel may take to end a process whose lease has expired."""
_LEAVES: Final = 3
"""The last third of a lease is for an orderly shutdown."""
_CLAIM_S: Final = 5.0
"""How long the arbiter waits for a request of the gateway to which a container moves, besides the time between two."""
_ASKS: Final = 6
"""How often a lease is renewed within its time."""


def waits_s(lease_s: float) -> float:
    """Returns how long the arbiter waits after it gave a lease, in seconds."""
    return lease_s * (1 + DRIFT) + MARGIN_S


class Lease(Struct, frozen=True):
    """The arbiter's answer to a request."""

    turn: str
    """The id of the lease with its renewals; empty: refused."""
    lease_s: float = 0.0
    why: str = ""
    """Why it is refused."""
    states: bytes = b""
    """With a new turn: the last saved states of the container's objects."""
    leave: bool = False
    """With a refusal: whether the container is to end now, with its state saved, since it moves."""


class Holder:
    """The holder: requests and renews a lease. Times are seconds of its own host's `uptime_s`.

    Args:
        now: the current time.
        arbiter: the arbiter's name.
    """

    def __init__(self, now: float, arbiter: str) -> None:
        self.turn = ""
        self.why = f"{arbiter} was not asked yet"
        """Why it has no lease."""
        self.term = TimerLease(-math.inf, -math.inf)
        """How long the container may run."""
        self.states = b""
        """The states with which the container starts."""
        self._arbiter = arbiter
        self._ask_at = now
        self._every_s = 1.0
        self._leave = False

    def held(self, now: float) -> bool:
        """Whether the container may run."""
        return self.keeps(now) and not self._leave

    def keeps(self, now: float) -> bool:
        """Whether the arbiter still saves the container's states."""
        return now < self.term.leave_at

    @property
    def within_s(self) -> float:
        """The timeout of a request: two intervals."""
        return 2 * self._every_s

    @property
    def due(self) -> float:
        """When to check next."""
        return min(self._ask_at, self.term.leave_at) if self.turn else self._ask_at

    def asks(self, now: float) -> bool:
        """Whether it is time for a request; its lease counts from now."""
        if now >= self.term.leave_at and self.turn:
            self.turn, self.why = "", self.why or f"{self._arbiter} does not answer"
        if now < self._ask_at:
            return False
        self._ask_at = now + self._every_s
        return True

    def answered(self, asked_at: float, turn: str, lease: Lease) -> None:
        """Handles the answer to a request of that time and turn."""
        if turn != self.turn:  # its lease at the request has ended meanwhile
            return
        self._leave = lease.leave
        if not lease.turn:
            self.why = lease.why
            return
        if not turn:
            self.states = lease.states
        until = max(self.term.until, asked_at + lease.lease_s)
        self.turn, self.why, self._every_s = lease.turn, "", lease.lease_s / _ASKS
        self.term = TimerLease(until - lease.lease_s / _LEAVES, until)

    def unanswered(self, reason: str) -> None:
        """Handles a request that was lost or could not be sent."""
        self.why = reason


class Arbiter:
    """The arbiter: gives leases, and runs the container itself once the last one has certainly expired.

    It starts as if the container ran here and had to be handed back, because an earlier boot may have left it running.

    Args:
        askers: the names of the other gateways.
        mark: an id unique to this boot.
        holder: the gateway that got the last lease of an earlier boot; empty: unknown.
    """

    def __init__(self, askers: Sequence[str], mark: str, holder: str = "") -> None:
        self.mine = True
        """Whether the container runs here, is to run here, or has not ended yet."""
        self.handing = True
        """Whether it is to end here and to be handed back."""
        self.turn = ""
        """The turn whose states are saved; empty: its own."""
        self.asked_at: dict[str, float] = {}
        """When each gateway made its last request."""
        self.holder = askers[0] if len(askers) == 1 else holder
        """The gateway that got the last lease; empty: unknown, or none since the container ran here."""
        self.moves_to: str | None = None
        """The gateway to which the container moves; empty: this one; None: it does not move."""
        self._askers = " or ".join(askers)
        self._free_at = math.inf
        self._held_until = math.inf
        """When the last lease has certainly expired."""
        self._ran = False
        """Whether the container ran here in this boot."""
        self._claim_s = _CLAIM_S
        self._mark = mark
        self._turns = 0

    @property
    def due(self) -> float:
        """When the other gateway's lease has certainly expired, unless it is renewed."""
        if self.mine:
            return math.inf
        is_unknown = not self.holder and self._held_until >= self._free_at  # any of the others may ask first
        return self._free_at + (self._claim_s if self.moves_to or is_unknown else 0.0)

    @property
    def why(self) -> str:
        """Why the container is not to run here."""
        if self.handing:
            return f"it is for {self.moves_to or self._askers} again"
        return f"{self.holder} has it" if self.turn else f"{self.holder or self._askers} may have it"

    def request(self, now: float, asker: str, turn: str, lease_s: float) -> bool:
        """Handles a request; returns whether the gateway ``asker`` gets the lease, then `turn` is its turn."""
        self.asked_at[asker] = now
        if self.mine or (self.moves_to is not None and asker != self.moves_to):
            return False
        if asker != self.holder and now < self._held_until:
            return False
        self._free_at = max(self._free_at, now + waits_s(lease_s))
        self._held_until, self._claim_s = self._free_at, _CLAIM_S + lease_s / _ASKS
        if not turn or turn != self.turn or asker != self.holder:
            self._turns += 1
            self.turn = f"{self._mark}.{self._turns}"
        self.holder, self.moves_to = asker, None
        return True

    def move(self, to: str) -> None:
        """Begins to move the container to another gateway; empty: to this one. No lease is renewed meanwhile."""
        self.moves_to = to
        self.handing = self.handing or (self.mine and bool(to))

    def take_if_free(self, now: float) -> bool:
        """Takes the container if the last lease has expired; returns whether it just did."""
        if self.mine or now < self.due:
            return False
        self.mine = self._ran = True
        self.turn = self.holder = ""
        self.moves_to = None
        return True

    def hand_back(self) -> None:
        """Begins to hand the container back; `ended` completes that."""
        self.handing, self.moves_to = self.mine, None

    def ended(self, now: float, lease_s: float) -> None:
        """Completes the hand-back: the container ended here, and is the other gateway's for at least one lease."""
        if self.handing:
            self.mine = self.handing = False
            self._free_at = now + waits_s(lease_s)
            self._held_until = now if self._ran else self._free_at  # of an earlier boot, a lease may be left
            self._ran = False
