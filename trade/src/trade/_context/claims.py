"""What a lock was taken for, and what of that it holds: the rest of it is not commanded under that lock."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple, Protocol

from msgspec import Struct

from trade._protocol.keys import Address
from trade._registry.constraints import Constraint
from trade._registry.registry import Record
from trade.errors import NotLocked


class Selection(NamedTuple):
    """What a lock is to be of, when it is taken."""

    resources: dict[Address, list[str]]
    """By the container that judges them."""
    missing: tuple[str, ...] = ()
    """What belongs to it and was not there."""


class Claim(Struct, frozen=True):
    """What a lock selects, and what of that it holds."""

    constraint: Constraint | None = None
    """None: it is of what it holds, and of nothing else."""
    held: dict[str, frozenset[str]] = {}
    """Resources, by the address of the container that judges them."""

    def with_held(self, address: Address, names: Iterable[str]) -> "Claim":
        """The same, and these are held, too."""
        there = str(address)
        return Claim(self.constraint, {**self.held, there: self.held.get(there, frozenset()).union(names)})

    def covers(self, record: Record) -> bool:
        """Whether all that a service uses is held."""
        return self.held.get(str(record.key.address), frozenset()).issuperset(record.used)

    def selects(self, record: Record) -> bool:
        """Whether it is meant for a service, held or not."""
        return self.constraint is not None and self.constraint.matches(record)


class Claiming(Protocol):
    """A lock, as far as this goes."""

    @property
    def claim(self) -> Claim: ...


def require_held(locks: Sequence[Claiming], record: Record) -> None:
    """What one of the locks around a command selects, one of them has to hold. Raises NotLocked."""
    if any(lock.claim.covers(record) for lock in locks):
        return
    for lock in locks:
        if lock.claim.selects(record):
            raise NotLocked(service=record.label, selected_by=str(lock.claim.constraint))
