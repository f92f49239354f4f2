"""A provider held still: nobody calls what actuates, nothing moves, until its state has been taken or given."""

import contextlib
import threading
import time
from collections.abc import Callable, Generator, Mapping
from typing import Any, Final

from trade._protocol.keys import Address
from trade._resources.grants import LockRequest
from trade._resources.lock_table import LockTable
from trade._resources.resource import Holder, Resource, locked
from trade._services.local_service import LocalService
from trade.errors import ConfigurationError, LockedByOther

CALLS_S: Final = 2.0
"""How long calls that run may take to end."""
LONGEST_S: Final = 60.0
"""A provider is held still no longer than this."""


class Frozen:
    """The resources of one provider, which nobody may use."""

    def __init__(self, table: LockTable, number: int, resources: tuple[Resource, ...]) -> None:
        self._table = table
        self._number = number
        """Of the grant that holds it still; 0 if nothing of it actuates."""
        self._resources = resources
        self._free: Callable[[], None] | None = None

    def check(self) -> None:
        """Whether it is still.

        Raises:
            LockedByOther: the lock that holds it was broken or has outlived its lease, or it moves.
            Stopped: somebody stopped it meanwhile.
        """
        if self._number and (why := self._table.over(self._number)):
            raise self._lost(why)
        require_rest(self._resources)

    def seal(self) -> None:
        """Let nobody in any more, also who has found it before it is withdrawn and gets to it after that.

        Raises:
            LockedByOther: see `check`.
        """
        if self._number:
            self._free = self._table.retire(self._number, "its provider has moved")
            if self._free is None:
                raise self._lost(self._table.over(self._number))

    def unseal(self) -> None:
        """It goes on."""
        if self._free is not None:
            self._free()

    def _lost(self, why: str) -> LockedByOther:
        names = tuple(resource.name for resource in self._resources)
        return LockedByOther(resources=names, owner=f"nobody any more: {why}", purpose="migrating")


class Quiescer:
    """Holds providers of one container still."""

    def __init__(self, table: LockTable, own: Address) -> None:
        self._table = table
        self._own = own

    @contextlib.contextmanager
    def frozen(
        self, services: Mapping[str, LocalService], alone: Callable[[], list[Resource]], purpose: str
    ) -> Generator[Frozen, None, None]:
        """Hold it still, once calls that run have ended.

        Args:
            services: of the provider, by name.
            alone: tells the resources that are only its own.
            purpose: as others are told who come meanwhile.

        Raises:
            LockedByOther: somebody has it locked, it moves, or a call does not end within `CALLS_S`.
            Stopped: a stop holds, which would be forgotten elsewhere.
            ConfigurationError: what it uses is used by another provider, too.
        """
        used = {resource for service in services.values() for resource in service.resources}
        moved = {one for service in services.values() if service.effect == "actuate" for one in service.resources}
        coupled = set(self._table.named(resource.name for resource in moved))
        if shared := (used | coupled) - set(alone()):
            problem = f"it shares {', '.join(sorted(one.name for one in shared))} with other services of this container"
            raise ConfigurationError(where=purpose, problem=problem)
        resources = tuple(sorted(used, key=lambda resource: resource.name))
        for resource in resources:
            if (holder := resource.holder or resource.pending) is not None:
                raise locked(resource, holder)
        require_rest(resources)
        own = self._own
        holder = Holder(own.identity, own.container, f"{own}/migration", purpose, time.time())
        terms = LockRequest(purpose=purpose, lease_s=LONGEST_S, wait_s=CALLS_S)
        granted = self._table.acquire([resource.name for resource in moved], holder, terms)
        number = 0 if granted.token is None else granted.token.number
        try:
            yield Frozen(self._table, number, resources)
        finally:
            self._table.release(number, own.identity)


def require_rest(resources: tuple[Resource, ...]) -> None:
    """Raises LockedByOther: one moves. Stopped: one was stopped, and nobody has resumed it."""
    for resource in resources:
        if (latch := resource.estop or resource.latch) is not None:
            raise latch.stopped(resource.name, estop=resource.estop is not None)
        if resource.moving:
            owner, purpose = ", ".join(resource.movers) or "somebody", "a motion that has not ended"
            raise LockedByOther(resources=(resource.name,), owner=owner, purpose=purpose)


BUDGET_S: Final = 5.0
"""How long a provider may take to give or take its state."""


def is_stateful(kind: type) -> bool:
    """Whether objects of a class can give and take their state."""
    return all(callable(getattr(kind, name, None)) for name in ("save_state", "restore_state"))


def save(provider: Any) -> Any:
    """The state of a provider; raises what it raises, and TimeoutError after `BUDGET_S`."""
    return _within_budget(provider.save_state, "save_state")


def restore(provider: Any, state: Any) -> None:
    """Give a provider its state; raises what it raises, and TimeoutError after `BUDGET_S`."""
    _within_budget(lambda: provider.restore_state(state), "restore_state")


def _within_budget(ask: Callable[[], Any], what: str) -> Any:
    """On a thread of its own: what hangs there for ever holds up nobody else."""
    results, errors, over = list[Any](), list[BaseException](), threading.Event()

    def run() -> None:
        try:
            results.append(ask())
        except BaseException as error:  # noqa: BLE001 - raised where it was asked for
            errors.append(error)
        over.set()

    threading.Thread(target=run, name=f"trade-{what}", daemon=True).start()
    if not over.wait(BUDGET_S):
        raise TimeoutError(f"{what} has not ended after {BUDGET_S:g} s")
    for error in errors:
        raise error
    return results[0]
