"""The lock services of every container, in group ``trade``."""

import threading
import time
from collections.abc import Callable, Iterable
from typing import Final

from msgspec import structs

from trade._context.call_context import CallContext, served_call
from trade._context.sessions import foreign
from trade._locks.remote_locks import RemoteLocks
from trade._resources.grants import Granted, LockInfo, LockRequest, StopInfo
from trade._resources.lock_table import LockTable
from trade._resources.resource import Holder, Resource
from trade._security.authorizer import Authorizer
from trade._services.decorator import service
from trade.errors import Busy, LockedByOther, TradeError
from trade.protocol.keys import Address
from trade.protocol.messages import Token

_MOST_WAITING: Final = 24
"""The most requests in the queues of a container; further clients ask again later."""

GroupsOf = Callable[[str], set[str]]
"""The groups of the services that use a resource."""
SendReleaseRequest = Callable[[Holder, Token, str, str], None]
"""Passes a release request to the holder of a grant: the holder, the grant, the requesting client and the reason."""
OnReleaseRequested = Callable[[Token, str, str], bool]
"""Takes such a request for a lock of this container; returns whether its owner handles requests."""


class LockServices:
    """The services of a `LockTable`."""

    def __init__(
        self,
        table: LockTable,
        own: Address,
        send_request: SendReleaseRequest,
        on_release_requested: OnReleaseRequested,
        access: Authorizer,
        groups: GroupsOf,
        remote_locks: RemoteLocks,
    ) -> None:
        self._table = table
        self._remote_locks = remote_locks
        self._access = access
        self._groups = groups
        self._own = own
        self._send_request = send_request
        self._on_release_requested = on_release_requested
        self._slots = threading.BoundedSemaphore(_MOST_WAITING)

    @service
    def acquire(self, resources: list[str], terms: LockRequest) -> Granted:
        """Locks all of these, and what is coupled to them, for the calling session."""
        call = served_call()
        named = self._table.named(resources)
        self._require(call, "lock", [resource.name for resource in named])
        calls = () if call.behalf is None else call.behalf.calls
        holder = Holder(
            identity=call.caller,
            container=_container_of(call.session),
            session=call.session,
            purpose=terms.purpose,
            since=time.time(),
            delegates=terms.delegates,
        )
        if not self._slots.acquire(blocking=False):
            raise Busy(service="trade.acquire", container=self._own.container)
        terms = structs.replace(terms, wait_s=call.patience_s(terms.wait_s))
        try:
            with self._remote_locks.acquire(
                call, named, terms, self._forward_request
            ) as remote_lock:  # at their homes first
                wait = structs.replace(terms, wait_s=max(0.0, terms.wait_s - remote_lock.waited_s))
                granted = self._table.acquire(resources, holder, wait, call.tokens, (call.id, *calls))
                try:
                    self._require(call, "lock", granted.resources)  # once more: it may have waited for long
                    remote_lock.bind(granted)
                except TradeError:
                    if granted.token is not None:
                        self._table.release(granted.token.number, call.caller)
                    raise
        finally:
            self._slots.release()
        return structs.replace(granted, waited_s=granted.waited_s + remote_lock.waited_s)

    def _forward_request(self, number: int, client: str, reason: str) -> None:
        """Passes on a release request from another system."""
        holders = [info.holder for info in self._table.infos() if info.token.number == number]
        if holders:
            self._send_request(holders[0], Token(self._own.epoch, number), client, reason)

    @service(effect="stop")
    def renew(self, grants: list[int]) -> dict[int, str]:
        """Renews the leases of these grants; returns why each of the others no longer holds."""
        held = self._table.renew(grants, served_call().caller)
        return {number: self._table.why_ended(number) or "it is another's" for number in grants if number not in held}

    @service(effect="stop")
    def release(self, grant: int, lost: str = "") -> bool:
        """Releases a grant; with ``lost``, the reason why its lock is lost, its motion stops."""
        identity = served_call().caller
        if lost and self._table.renew([grant], identity):
            return self._table.lose(grant, lost)
        held = self._table.release(grant, identity)
        if held:
            self._remote_locks.release(grant)
        return held

    @service(effect="read")
    def locks(self) -> list[LockInfo]:
        """The locks of this container's resources, with owners and waiters; also what could not be stopped."""
        return self._table.infos() + self._table.withheld()

    @service(effect="read")
    def stops(self) -> list[StopInfo]:
        """The stops that hold this container's resources: which client stopped each, and why."""
        return self._table.stops()

    @service(effect="stop")
    def break_lock(self, grant: int, reason: str) -> bool:
        """Takes a lock away from its owner; its motion stops. Returns whether it was held."""
        call = served_call()
        held = [info.resources for info in self._table.infos() if info.token.number == grant]
        self._require(call, "administer", held[0] if held else ())
        return self._table.lose(grant, f"broken by {call.caller}: {reason}")

    @service
    def request_release(self, resources: list[str], reason: str) -> list[str]:
        """Asks the owners of these to release them; returns who was asked."""
        call = served_call()
        client = foreign(call.session) or f"{call.caller}/{_container_of(call.session)}"
        holders: dict[Token, Holder] = {}
        for resource in self._table.named(resources):
            if (holder := resource.holder) is not None:
                holders[Token(self._own.epoch, resource.live)] = holder
        for token, holder in holders.items():
            self._send_request(holder, token, client, reason)
        free = [resource for resource in self._table.named(resources) if resource.holder is None]
        return [holder.owner for holder in holders.values()] + self._remote_locks.request_release(call, free, reason)

    @service
    def release_requested(self, token: Token, requester: str, reason: str) -> bool:
        """Takes a release request for a lock of this container; returns whether its owner handles requests."""
        return self._on_release_requested(token, requester, reason)

    @service
    def resume(self, resources: list[str]) -> list[str]:
        """Lets these move again after a stop; for the owner of their lock, or, if unlocked, for an administrator."""
        call = served_call()
        found = self._table.named(resources)
        for resource in found:
            if resource.holder is not None and not self._is_for(resource, resource.holder, call):
                raise LockedByOther(
                    resources=(resource.name,),
                    owner=resource.holder.owner,
                    purpose=resource.holder.purpose,
                    since=resource.holder.since,
                )
        self._require(call, "administer", [resource.name for resource in found if resource.holder is None])
        there = self._remote_locks.resume(call, found)
        return [resource.name for resource in found if _resumed(resource) or resource.name in there]

    def _is_for(self, resource: Resource, holder: Holder, call: CallContext) -> bool:
        """Whether a call is made for the holder of a lock, or under it, as by the command of `trade lock`.

        The caller states its session and tokens itself, so its identity must match, too.
        """
        mine = holder.session in call.sessions or Token(self._own.epoch, resource.live) in call.tokens
        return mine and (call.caller == holder.identity or call.caller in holder.delegates)

    def _require(self, call: CallContext, verb: str, resources: Iterable[str]) -> None:
        """Checks that the caller has the right over at least one service that uses each resource.

        Raises:
            AccessDenied: the policy gives it the right over none of them.
        """
        for name in resources if self._access.policy is not None else ():
            self._access.require_any(call.caller, verb, self._groups(name), name)


def _resumed(resource: Resource) -> bool:
    was = resource.latch is not None or bool(resource.unsafe)
    resource.resume()
    return was


def _container_of(session: str) -> str:
    return session.split("/")[1] if session.count("/") >= 2 else session
