"""An outgoing call: its deadline, and the locks, session and outer call that it inherits from its context."""

from collections.abc import Iterable, Sequence
from contextvars import ContextVar
from time import monotonic_ns
from typing import Final, Protocol

from msgspec import Struct

from trade._context.call_context import CallContext, running
from trade._context.sessions import Session, speaking
from trade._registry.constraints import Constraint
from trade._registry.registry import Record
from trade.errors import Cancelled, LockLost, NotLocked
from trade.protocol.keys import DOMAIN, Address
from trade.protocol.messages import Behalf, Token

DEFAULT_DEADLINE_S: Final = 10.0
_DEFAULT_DEADLINE_NS: Final = int(DEFAULT_DEADLINE_S * 1e9)
_NO_BEHALF: Final = Behalf()


class Claim(Struct, frozen=True):
    """What a lock selects, and which part of that it holds."""

    constraint: Constraint | None = None
    """None: it selects exactly what it holds."""
    held: dict[str, frozenset[str]] = {}
    """Resources, by the address of the container that grants them."""

    def with_held(self, address: Address, names: Iterable[str]) -> "Claim":
        """The same claim with further held resources."""
        there = str(address)
        return Claim(self.constraint, {**self.held, there: self.held.get(there, frozenset()).union(names)})

    def covers(self, record: Record) -> bool:
        """Whether it holds all resources of a service."""
        return self.held.get(str(record.key.address), frozenset()).issuperset(record.used)

    def selects(self, record: Record) -> bool:
        """Whether it selects a service, held or not."""
        return self.constraint is not None and self.constraint.matches(record)


class UsableLock(Protocol):
    """A lock that the running code holds or uses: a `Lock`, or an `InheritedLock`."""

    @property
    def owner(self) -> Address:
        """The container that owns the lock; calls of other containers in this process do not carry it."""
        ...

    @property
    def held(self) -> bool:
        """Whether it holds now."""
        ...

    @property
    def claim(self) -> Claim:
        """The selection of the lock, and the part of it that the lock holds."""
        ...

    def tokens(self) -> Iterable[Token]:
        """Its proofs for the containers that granted it; raises LockLost if it no longer holds."""
        ...

    def refused(self, by: Address, error: LockLost) -> None:
        """Handles the refusal of a call made under it."""
        ...


holding: ContextVar[tuple[UsableLock, ...]] = ContextVar("trade_locks", default=())
"""The locks around the running code, outermost first."""

handed_down: Final[dict[Address, UsableLock]] = {}
"""Locks that other processes passed on to this one, by the container whose calls carry them."""


class Inherited(Struct, gc=False):
    """What a call inherits from its context; most calls inherit nothing."""

    outer: CallContext | None
    """The call that makes it."""
    around: tuple[UsableLock, ...]
    """The locks around it."""
    client: Session | None
    """The client that it is made for; None: the container itself."""
    asked_s: float
    """Its deadline without that of the outer call, which a stop ignores: a stop is sent however late it is."""
    asked_ns: int

    def session(self, own: Address) -> str:
        """The client's session, if that container acts for one; else empty.

        Raises:
            SessionEnded: the client has disconnected.
        """
        if self.client is None or self.client.owner != own:
            return ""
        self.client.check()
        return self.client.name

    def behalf(self, record: Record, own: Address) -> Behalf | None:
        """The context that the call passes on; for a stop, it does not include locks.

        Raises:
            LockLost: the call actuates under a lock that no longer holds.
            NotLocked: the call actuates, and the locks around it select its service but do not hold it.
            Cancelled: the call actuates, and its outer call was cancelled.
        """
        effect = record.info.effect
        commands = effect == "actuate" and record.key.domain != DOMAIN  # the middleware's own functions have no owner
        outer, around = self.outer, self.around
        if own in handed_down:
            around = (handed_down[own], *around)
        if outer is None and not around:
            return None
        if commands and outer is not None and outer.cancelled:
            raise Cancelled(service=record.label)
        locks = [lock for lock in around if lock.owner == own]
        tokens: tuple[Token, ...] = ()
        if effect != "stop":
            tokens = tuple(token for lock in locks if effect == "actuate" or lock.held for token in lock.tokens())
        if commands:
            _require_held(locks, record)
        if outer is None:
            return Behalf((), (), tokens) if tokens else None
        inherited = outer.behalf or _NO_BEHALF
        if effect != "stop":
            tokens += inherited.tokens
        return Behalf(outer.sessions, (outer.id, *inherited.calls), tokens)


class Request(Struct, gc=False):
    """One outgoing call."""

    deadline_s: float
    deadline_ns: int
    chain: tuple[str, ...] = ()
    inherited: Inherited | None = None

    def presence(self, record: Record, own: Address) -> tuple[Behalf | None, str]:
        """What it is made on behalf of, and its session if that is not the container's own.

        Raises:
            LockLost, NotLocked: a lock around it no longer holds, or selects its service without holding it.
            SessionEnded, Cancelled: its client has disconnected, or its outer call was cancelled.
        """
        inherited = self.inherited
        return (None, "") if inherited is None else (inherited.behalf(record, own), inherited.session(own))

    def refused(self, by: Address, error: BaseException) -> None:
        """Informs the locks around it of a refusal at once, before their next renewal."""
        if isinstance(error, LockLost) and self.inherited is not None:
            for lock in (*self.inherited.around, *handed_down.values()):
                lock.refused(by, error)

    def ignore_outer_deadline(self) -> None:
        if self.inherited is not None:
            self.deadline_s, self.deadline_ns = self.inherited.asked_s, self.inherited.asked_ns


def new_request(deadline_s: float | None) -> Request:
    """A new outgoing call in the current context."""
    now, outer, around, client = monotonic_ns(), running.get(), holding.get(), speaking.get()
    asked_s, asked_ns = DEFAULT_DEADLINE_S if deadline_s is None else deadline_s, now + in_ns(deadline_s)
    if outer is None and client is None and not around and not handed_down:
        return Request(asked_s, asked_ns)
    inherited = Inherited(outer, around, client, asked_s, asked_ns)
    if outer is None:
        return Request(asked_s, asked_ns, (), inherited)
    chain = (*outer.chain, outer.service)
    if outer.expires_ns is None or outer.expires_ns >= asked_ns:
        return Request(asked_s, asked_ns, chain, inherited)
    return Request(max(0.0, (outer.expires_ns - now) / 1e9), outer.expires_ns, chain, inherited)


def in_ns(deadline_s: float | None) -> int:
    return _DEFAULT_DEADLINE_NS if deadline_s is None else int(deadline_s * 1e9)


def _require_held(locks: Sequence[UsableLock], record: Record) -> None:
    """Raises NotLocked if the locks around a command select its service but none of them holds it."""
    if any(lock.claim.covers(record) for lock in locks):
        return
    for lock in locks:
        if lock.claim.selects(record):
            raise NotLocked(service=record.label, selected_by=str(lock.claim.constraint))
