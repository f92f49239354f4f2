"""Locks in other systems behind the grants of this container: the home of a shared resource grants its locks."""

import contextlib
import time
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextvars import Context
from typing import Final, Protocol

from msgspec import structs

from trade._context.call_context import CallContext
from trade._locks.lock import Lock, OnLost, OnRequest
from trade._resources.grants import Granted, LockRequest
from trade._resources.lock_table import LockTable
from trade._resources.resource import Resource
from trade.errors import LockLost
from trade.protocol.keys import Address
from trade.protocol.messages import Token

Wanted = Mapping[Address, Sequence[str]]
"""Resources of one other system, by the container that grants their locks."""
OnReleaseRequest = Callable[[int, str, str], None]
"""Takes a release request for the locks behind a grant: the grant, the requesting client and the reason."""


class RemoteSystem(Protocol):
    """Access to another system, for a call that was made in this one."""

    def lock(
        self, call: CallContext, wanted: Wanted, terms: LockRequest, on_lost: OnLost, on_request: OnRequest
    ) -> Lock: ...
    def resume(self, call: CallContext, address: Address, names: Sequence[str]) -> list[str]: ...
    def request_release(self, call: CallContext, address: Address, names: Sequence[str], reason: str) -> list[str]: ...


class SharedResource(Resource):
    """A resource of another system, as it is known here."""

    __slots__ = ("__weakref__", "home", "home_name", "remote_system")

    def __init__(self, name: str, home: Address, home_name: str, remote_system: RemoteSystem) -> None:
        super().__init__(name)
        self.home: Final = home
        self.home_name: Final = home_name
        self.remote_system: Final = remote_system

    def stop(
        self,
        by: str,
        sessions: Iterable[str] = (),  # noqa: ARG002
        reason: str = "stop() was called",
        *,
        estop: bool = False,
    ) -> None:
        """Makes earlier permits void; its home decides whether the stop latches."""
        super().stop(by, (), reason, estop=estop)


class RemoteLock:
    """The locks in other systems behind one grant."""

    def __init__(self, remote_locks: "RemoteLocks", on_request: OnReleaseRequest) -> None:
        self._remote_locks = remote_locks
        self._on_request = on_request
        self.number = 0
        """The number of the grant; 0 while it has none."""
        self.locks: list[Lock] = []
        self.waited_s = 0.0
        """How long it took to acquire them."""

    def bind(self, granted: Granted) -> None:
        """Binds them to that grant. Raises LockLost if one of the two no longer holds."""
        if granted.token is not None and self.locks:
            self.number = granted.token.number
            self._remote_locks.keep(self)

    def on_lost(self, error: LockLost) -> None:
        """Handles the loss of a lock in another system."""
        self._remote_locks.lose(self.number, error.reason)

    def on_release_request(self, client: str, reason: str) -> None:
        """Handles a release request from another system."""
        self._on_request(self.number, client, reason)

    def release(self) -> None:
        """Releases them, in no client's context."""
        for lock in self.locks:
            Context().run(lock.release)


class RemoteLocks:
    """The locks of one container in other systems, by its own grants."""

    def __init__(self, table: LockTable, epoch: str) -> None:
        self._table = table
        self._epoch = epoch
        self._by_grant: dict[int, RemoteLock] = {}
        table.on_loss(self._lost)

    @contextlib.contextmanager
    def acquire(
        self, call: CallContext, resources: Iterable[Resource], terms: LockRequest, on_request: OnReleaseRequest
    ) -> Generator[RemoteLock, None, None]:
        """Locks the shared ones of these at their homes; releases them unless they are bound to a grant then.

        Raises:
            TradeError: the error of the home.
        """
        remote_lock, begun = RemoteLock(self, on_request), time.monotonic()
        try:
            for remote_system, wanted in _by_system(resources).items():
                remaining = structs.replace(terms, wait_s=max(0.0, terms.wait_s - remote_lock.waited_s))
                remote_lock.locks.append(
                    remote_system.lock(call, wanted, remaining, remote_lock.on_lost, remote_lock.on_release_request)
                )
                remote_lock.waited_s = time.monotonic() - begun
            yield remote_lock
        finally:
            if not remote_lock.number:
                remote_lock.release()

    def keep(self, remote_lock: RemoteLock) -> None:
        """Keeps the locks of a grant. Raises LockLost if one of them, or the grant, no longer holds."""
        number = remote_lock.number
        self._by_grant[number] = remote_lock
        reason = self._table.why_ended(number) or next(
            (_lapsed(lock) for lock in remote_lock.locks if not lock.held), ""
        )
        if reason:
            self._by_grant.pop(number, None)
            remote_lock.number = 0
            raise LockLost(
                resources=tuple(name for lock in remote_lock.locks for name in lock.resources), reason=reason
            )

    def lose(self, number: int, reason: str) -> None:
        """Revokes a grant, because a lock behind it is lost."""
        if number:
            self._table.lose(number, reason)

    def _lost(self, number: int, reason: str) -> None:
        """Gives up the locks behind a revoked grant, so that their motion stops, too; called by the table."""
        remote_lock = self._by_grant.pop(number, None)
        for lock in () if remote_lock is None else remote_lock.locks:
            lock.lose(reason)

    def release(self, number: int) -> None:
        """Releases the locks behind a released grant."""
        remote_lock = self._by_grant.pop(number, None)
        if remote_lock is not None:
            remote_lock.release()

    def of_call(self, call: CallContext) -> tuple[Lock, ...]:
        """The locks in other systems behind the tokens of a call."""
        return tuple(lock for token in call.tokens if self._may_show(call, token) for lock in self._behind(token))

    def _may_show(self, call: CallContext, token: Token) -> bool:
        return token.epoch == self._epoch and self._table.may_use(token.number, call.caller)

    def _behind(self, token: Token) -> Sequence[Lock]:
        remote_lock = self._by_grant.get(token.number)
        return () if remote_lock is None else remote_lock.locks

    def resume(self, call: CallContext, resources: Iterable[Resource]) -> list[str]:
        """Resumes the shared ones of these; returns those that were stopped, by their names here."""
        shared = [one for one in resources if isinstance(one, SharedResource)]
        return [one.name for one in shared if one.remote_system.resume(call, one.home, [one.home_name])]

    def request_release(self, call: CallContext, resources: Iterable[Resource], reason: str) -> list[str]:
        """Asks the owners of the shared ones of these to release them; returns who was asked."""
        clients = [
            client
            for remote_system, wanted in _by_system(resources).items()
            for address, names in wanted.items()
            for client in remote_system.request_release(call, address, names, reason)
        ]
        return list(dict.fromkeys(clients))


def _lapsed(lock: Lock) -> str:
    try:
        lock.check()
    except LockLost as lost:
        return lost.reason
    return "it was given back"


def _by_system(resources: Iterable[Resource]) -> dict[RemoteSystem, dict[Address, list[str]]]:
    found: dict[RemoteSystem, dict[Address, list[str]]] = {}
    for one in resources:
        if isinstance(one, SharedResource):
            found.setdefault(one.remote_system, {}).setdefault(one.home, []).append(one.home_name)
    return found
