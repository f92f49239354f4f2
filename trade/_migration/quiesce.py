"""Holds a provider still: blocks calls that actuate, and motion, until its state has been taken or given."""

import contextlib
import threading
import time
from collections.abc import Callable, Generator, Mapping
from typing import Any, Final

from trade._resources.grants import LockRequest
from trade._resources.lock_table import LockTable
from trade._resources.resource import Holder, Resource, locked
from trade._services.local_service import LocalService
from trade.errors import ConfigurationError, LockedByOther
from trade.protocol.keys import Address

CALLS_S: Final = 2.0
"""How long running calls may take to end."""
LONGEST_S: Final = 60.0
"""The longest time that a provider is held still."""


class BlockedResources:
    """The resources of one provider, blocked for every client."""

    def __init__(self, table: LockTable, number: int, resources: tuple[Resource, ...]) -> None:
        self._table = table
        self._number = number
        """The number of the grant that holds them; 0 if no service of the provider actuates."""
        self._resources = resources
        self._free: Callable[[], None] | None = None

    def check(self) -> None:
        """Check that the provider is still held.

        Raises:
            LockedByOther: the lock that holds it was broken or its lease expired, or it moves.
            Stopped: a client stopped it meanwhile.
        """
        if self._number and (reason := self._table.why_ended(self._number)):
            raise self._lost(reason)
        require_rest(self._resources)

    def seal(self) -> None:
        """Block it permanently, also for calls that found it before it was withdrawn and reach it only later.

        Raises:
            LockedByOther: see `check`.
        """
        if self._number:
            self._free = self._table.retire(self._number, "its provider has moved")
            if self._free is None:
                raise self._lost(self._table.why_ended(self._number))

    def unseal(self) -> None:
        """Release the resources: the provider continues."""
        if self._free is not None:
            self._free()

    def _lost(self, reason: str) -> LockedByOther:
        names = tuple(resource.name for resource in self._resources)
        return LockedByOther(resources=names, owner=f"no owner any more: {reason}", purpose="migrating")


class Quiescer:
    """Holds providers of one container still."""

    def __init__(self, table: LockTable, own: Address) -> None:
        self._table = table
        self._own = own

    @contextlib.contextmanager
    def frozen(
        self, services: Mapping[str, LocalService], alone: Callable[[], list[Resource]], purpose: str
    ) -> Generator[BlockedResources, None, None]:
        """Hold a provider still once its running calls have ended.

        Args:
            services: its services, by name.
            alone: returns the resources that only this provider uses.
            purpose: the purpose shown to other clients meanwhile.

        Raises:
            LockedByOther: a client has it locked, it moves, or a call does not end within `CALLS_S`.
            Stopped: a stop is in force, which the other container would not know.
            ConfigurationError: another provider uses its resources, too.
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
            yield BlockedResources(self._table, number, resources)
        finally:
            self._table.release(number, own.identity)


def require_rest(resources: tuple[Resource, ...]) -> None:
    """Raises LockedByOther: a resource moves. Stopped: a resource was stopped and has not been resumed."""
    for resource in resources:
        if (latch := resource.estop or resource.latch) is not None:
            raise latch.stopped(resource.name, estop=resource.estop is not None)
        if resource.moving:
            owner, purpose = ", ".join(resource.movers) or "a client", "a motion that has not ended"
            raise LockedByOther(resources=(resource.name,), owner=owner, purpose=purpose)


BUDGET_S: Final = 5.0
"""How long a provider may take to save or restore its state."""


def is_stateful(provider_class: type) -> bool:
    """Whether objects of a class can save and restore their state."""
    return all(callable(getattr(provider_class, name, None)) for name in ("save_state", "restore_state"))


def save(provider: Any) -> Any:
    """The state of a provider; raises what it raises, and TimeoutError after `BUDGET_S`."""
    return _within_budget(provider.save_state, "save_state")


def restore(provider: Any, state: Any) -> None:
    """Give a provider its state; raises what it raises, and TimeoutError after `BUDGET_S`."""
    _within_budget(lambda: provider.restore_state(state), "restore_state")


def _within_budget(ask: Callable[[], Any], method: str) -> Any:
    """Calls on its own thread: a call that hangs blocks nothing else."""
    results, errors, ended = list[Any](), list[BaseException](), threading.Event()

    def run() -> None:
        try:
            results.append(ask())
        except BaseException as error:  # noqa: BLE001 - raised again in the calling thread
            errors.append(error)
        ended.set()

    threading.Thread(target=run, name=f"trade-{method}", daemon=True).start()
    if not ended.wait(BUDGET_S):
        raise TimeoutError(f"{method} has not ended after {BUDGET_S:g} s")
    for error in errors:
        raise error
    return results[0]
