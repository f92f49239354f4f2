"""Locks that are broken on purpose, each in one way: the checker must find every one of them.

They exist in the checker's own driver processes only, and nowhere else.
"""

import math
import os
from collections.abc import Callable
from typing import Any

from trade._resources.lock_table import LockTable
from trade._resources.resource import Permit, Resource
from trade.errors import LockLost
from trade.protocol.messages import Token


def _no_fence() -> None:
    """No fence is checked before bytes go out."""
    Permit.gate = lambda self: None  # type: ignore[method-assign]


def _geq() -> None:
    """The fence asks for at least the grant that holds, so it is open while none does."""

    def gate(self: Permit) -> None:
        for resource, live, _ in self.fences:
            if live < resource.live:
                raise LockLost(resources=(resource.name,), reason="there is a newer one")

    Permit.gate = gate  # type: ignore[method-assign]


def _no_drain() -> None:
    """Granted on while calls still run."""
    LockTable._running = lambda self, waiter: None  # type: ignore[method-assign]


def _no_expiry() -> None:
    """Leases never end."""
    LockTable.expire = lambda self: math.inf  # type: ignore[method-assign]
    LockTable.why_ended = lambda self, number: "" if number in self._grants else "it ended"  # type: ignore[method-assign]


def _zombie_epoch() -> None:
    """A token of another boot is as good as one of this."""
    check = Resource.check

    def lenient(self: Resource, tokens: Any, caller: str, session: str = "") -> None:
        check(self, [Token(self.epoch, token.number) for token in tokens if token.number == self.live], caller, session)

    Resource.check = lenient  # type: ignore[method-assign]


MUTANTS: dict[str, Callable[[], None]] = {
    "no-fence": _no_fence,
    "geq": _geq,
    "no-drain": _no_drain,
    "no-expiry": _no_expiry,
    "zombie-epoch": _zombie_epoch,
}


def mutate() -> None:
    """Become what ``TRADE_MUTANT`` says; raises KeyError for one there is not."""
    name = os.environ.pop("TRADE_MUTANT", "")  # TRADE itself knows no such variable, and would say so
    if name:
        MUTANTS[name]()
