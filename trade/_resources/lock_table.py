"""The lock table of a container: which client holds which of its resources, for how long, and which one is next.

The container grants locks of its own resources, on its own clock. The owner's side of a lock, which requests and renews
it, is `_locks.lease_client`.
"""

import math
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Final

from msgspec import structs

from trade._audit.events import Audit
from trade._context.sessions import EndedSessions, within
from trade._resources.grants import Grant, Granted, LockInfo, LockRequest, StopInfo, Waiter, withheld
from trade._resources.resource import Holder, Latch, Resource, locked, not_stopped
from trade._threads.scheduler import Scheduler
from trade.errors import LockedByOther, NotStopped, ServiceGone, SessionEnded, TradeError
from trade.protocol.messages import Token

_STOPPING: Final = Holder("trade", "", "", "stopping what moved under a lock that was lost", 0.0)

_REMEMBERED: Final = 256
"""How many ended grants it remembers, with the reasons."""
_LEASE_ENDED: Final = "its lease ended"
_END_S: Final = 2.0

Stop = Callable[[Sequence[Resource], str, Callable[[Resource, str], None]], None]
"""Stops resources for a reason, without waiting; reports each stop when it is over, and why if it failed."""


class LockTable:
    """The resources of one container, and the locks that hold on them.

    Args:
        epoch: of the container.
        container: its name.
        timers: ends leases, on the clock of locks.
        audit: records locks.
    """

    def __init__(self, epoch: str, container: str, timers: Scheduler, audit: Audit | None = None) -> None:
        self._audit = audit or Audit()
        self._epoch = epoch
        self._container = container
        self._stop: Stop = _stop_nothing
        self._on_loss: Callable[[int, str], None] = lambda _number, _reason: None
        self._wait_clock = timers.clock
        self._clock = self._wait_clock.now
        self._resources: dict[str, tuple[Resource, int]] = {}
        """Resources by name, with the number of services that use them."""
        self._grants: dict[int, Grant] = {}
        self._ended: dict[int, str] = {}
        """Why the last grants ended, by number."""
        self._sessions = EndedSessions()
        self._waiting: list[Waiter] = []
        """Requests that wait for their turn, next first."""
        self._acquiring: list[Waiter] = []
        """Requests that wait for their turn, or for running calls and motion."""
        self._count = 0
        self._changed = threading.Condition(threading.RLock())
        self._leases = timers.due(lambda: self.expire() * 1e9)
        self._closed = False
        self._estop: Latch | None = None

    def stop_with(self, stop: Stop) -> None:
        """Sets how motion under a lost lock is stopped."""
        self._stop = stop

    def on_loss(self, callback: Callable[[int, str], None]) -> None:
        """Calls this with each grant that is revoked, and the reason; it must not wait."""
        self._on_loss = callback

    # --- resources

    def adopt(self, named: Resource | str) -> Resource:
        """The resource of that name, created if it is new; `drop` releases it.

        Raises:
            ValueError: the name belongs to another object.
        """
        name = named if isinstance(named, str) else named.name
        with self._changed:
            known, uses = self._resources.get(name, (None, 0))
            resource = known or (named if isinstance(named, Resource) else Resource(name))
            if isinstance(named, Resource) and resource is not named:
                raise ValueError(f"resource {name} is another object already; share one trade.Resource")
            if known is None:  # a newly offered resource has no holder
                resource.live, resource.holder = 0, None
            resource.epoch, resource.why_ended = self._epoch, self.why_ended
            resource.session_error = self._sessions.session_error
            resource.estop = self._estop
            resource.on_rest(self._rested)
            self._resources[name] = (resource, uses + 1)
            return resource

    def estop(self, latch: Latch | None) -> None:
        """Latches every resource, present and future, or releases the latch (None)."""
        with self._changed:
            self._estop = latch
            for resource, _ in self._resources.values():
                resource.estop = latch

    def drop(self, resource: Resource) -> None:
        """Releases one service's use. After the last one its locks are lost and its waiters are refused."""
        with self._changed:
            known, uses = self._resources[resource.name]
            if uses > 1:
                self._resources[resource.name] = (known, uses - 1)
                return
            del self._resources[resource.name]
            for waiter in self._acquiring:
                if resource in waiter.resources:
                    waiter.dropped = f"{resource.name} is no longer offered"
            self._changed.notify_all()
        self.lose(resource.live, f"{resource.name} is no longer offered")

    def resources(self) -> list[Resource]:
        """All resources, sorted by name."""
        with self._changed:
            return [self._resources[name][0] for name in sorted(self._resources)]

    def named(self, names: Iterable[str]) -> tuple[Resource, ...]:
        """The resources of these names and those coupled to them, in the common order of locking.

        Raises:
            ServiceGone: one does not exist here, or no longer.
        """
        wanted, found = list(names), dict[str, Resource]()
        with self._changed:
            while wanted:
                name = wanted.pop()
                if name in found:
                    continue
                if name not in self._resources:
                    raise ServiceGone(service=name, reason=f"container {self._container} has no such resource")
                found[name] = self._resources[name][0]
                wanted.extend(other for other in found[name].coupled if other in self._resources)
        return tuple(found[name] for name in sorted(found))

    # --- locking

    def acquire(
        self,
        names: Sequence[str],
        holder: Holder,
        terms: LockRequest,
        tokens: Iterable[Token] = (),
        calls: Iterable[int] = (),
    ) -> Granted:
        """Waits for the client's turn, then until running calls and motion end, and grants all resources.

        Args:
            names: of resources; those coupled to them are included.
            holder: the requesting client.
            terms: the terms of the request.
            tokens: the locks around the requesting call; what they hold is not requested again.
            calls: the requesting call and its outer ones, which are not waited for.

        Raises:
            LockedByOther: not within the given times; nothing is held then.
            NotStopped: a required stop of one failed, so no client gets it.
            ServiceGone: one does not exist here.
            SessionEnded: the client's session has ended.
        """
        mine = set(tokens)
        resources = tuple(one for one in self.named(names) if Token(self._epoch, one.live) not in mine)
        if not resources:
            return Granted(None, ())
        requested_at = self._clock()
        with self._changed:
            if (ended := self.session_error((holder.session,))) is not None:
                raise ended
            self._count += 1
            waiter = Waiter((-terms.priority, self._count), resources, holder, frozenset(calls))
            self._acquiring.append(waiter)
            try:
                self._take_turn(waiter, requested_at + terms.wait_s)
                return self._empty_and_grant(waiter, terms, requested_at)
            finally:
                self._acquiring.remove(waiter)

    def _empty_and_grant(self, waiter: Waiter, terms: LockRequest, requested_at: float) -> Granted:
        try:
            self._drain(waiter, requested_at + terms.wait_s)
            return self._grant(waiter, terms, requested_at)
        finally:
            for resource in waiter.resources:
                resource.pending = None
            self._changed.notify_all()

    def _take_turn(self, waiter: Waiter, until: float) -> None:
        """Waits until no client holds any of them and no earlier one waits for any; then new calls are refused."""
        self._waiting.append(waiter)
        self._waiting.sort(key=lambda one: one.order)
        try:
            while (obstacle := self._obstacle(waiter)) is not None:
                self._wait(waiter, until, obstacle)
        finally:
            self._waiting.remove(waiter)
            self._changed.notify_all()
        for resource in waiter.resources:
            resource.pending = waiter.holder

    def _obstacle(self, waiter: Waiter) -> TradeError | None:
        if (unsafe := self._unsafe(waiter)) is not None:
            return unsafe
        for resource in waiter.resources:
            if resource.live:
                return locked(resource, resource.holder, waiter.holder.session)
            if resource.pending is not None:
                return locked(resource, resource.pending, waiter.holder.session)
        for earlier in self._waiting:
            if earlier is waiter:
                return None
            shared = next((one for one in waiter.resources if one in earlier.resources), None)
            if shared is not None:  # in strict order, so that every wait is bounded
                return locked(shared, earlier.holder, waiter.holder.session)
        return None

    def _unsafe(self, waiter: Waiter) -> NotStopped | None:
        return next((not_stopped(one, self._container) for one in waiter.resources if one.unsafe), None)

    def _drain(self, waiter: Waiter, until: float) -> None:
        while (running := self._running(waiter)) is not None:
            owner = ", ".join(running.movers) or "another client"
            purpose = "a call or a motion that has not ended"
            self._wait(waiter, until, LockedByOther(resources=(running.name,), owner=owner, purpose=purpose))
            if (unsafe := self._unsafe(waiter)) is not None:  # its mover has ended meanwhile, but the motion has not
                raise unsafe

    def _wait(self, waiter: Waiter, until: float, obstacle: TradeError) -> None:
        left = until - self._clock()
        if left <= 0 or waiter.dropped or self._closed or isinstance(obstacle, NotStopped):
            raise obstacle
        self._wait_clock.wait(self._changed, left, again=False)

    def _running(self, waiter: Waiter) -> Resource | None:
        """One of them that calls outside the requesting chain still use."""
        for resource in waiter.resources:
            others = [call for call in list(resource.calls) if call not in waiter.calls]
            if others or (resource.moving and not resource.calls):
                return resource
        return None

    def _grant(self, waiter: Waiter, terms: LockRequest, requested_at: float) -> Granted:
        if waiter.dropped:
            raise ServiceGone(service=", ".join(one.name for one in waiter.resources), reason=waiter.dropped)
        self._count += 1
        now, number = self._clock(), self._count
        holder = structs.replace(waiter.holder, since=time.time())
        grant = Grant(number, waiter.resources, holder, terms.lease_s, now + terms.lease_s)
        self._grants[number] = grant
        for resource in waiter.resources:
            resource.holder, resource.live = holder, number
            resource.uses, resource.used_at = 0, 0.0
        self._leases.by(grant.until * 1e9)
        self._record("locked", grant, holder.purpose and f"for {holder.purpose}")
        return Granted(Token(self._epoch, number), tuple(one.name for one in grant.resources), now - requested_at)

    # --- while it is held

    def renew(self, numbers: Iterable[int], identity: str) -> list[int]:
        """Renews leases; returns the grants that still hold."""
        with self._changed:
            now = self._clock()
            held = [self._grants[number] for number in numbers if number in self._grants]
            own = [grant for grant in held if grant.holder.identity == identity and grant.until > now]
            for grant in own:
                grant.until = now + grant.lease_s
            return [grant.number for grant in own]

    def why_ended(self, number: int) -> str:
        """Why a grant no longer holds; empty if it holds."""
        grant = self._grants.get(number)
        if grant is None:
            return self._ended.get(number, "it ended long ago")
        return "" if grant.until > self._clock() else _LEASE_ENDED

    def may_use(self, number: int, identity: str) -> bool:
        """Whether a grant holds and that identity may use it."""
        grant = self._grants.get(number)
        return grant is not None and (identity == grant.holder.identity or identity in grant.holder.delegates)

    def release(self, number: int, identity: str) -> bool:
        """Releases a grant; motion continues, and the next holder waits for it. Returns whether it held."""
        with self._changed:
            grant = self._grants.get(number)
            if grant is None or grant.holder.identity != identity:
                return False
            self._end(grant, "it was given back")
            self._record("unlocked", grant)
            return True

    def retire(self, number: int, reason: str) -> Callable[[], None] | None:
        """Ends a grant without freeing its resources, for resources about to be dropped; None if it has ended.

        No other client can get them in between. Returns a function that frees them after all.
        """
        with self._changed:
            grant = self._grants.pop(number, None)
            if grant is None:
                return None
            self._ended[number] = reason
            self._record("lock lost", grant, reason)

        def free() -> None:
            with self._changed:
                for resource in grant.resources:
                    if resource.live == number:
                        resource.live, resource.holder = 0, None
                self._changed.notify_all()

        return free

    def lose(self, number: int, reason: str) -> bool:
        """Revokes a grant: its motion stops, and only then the next client gets it. Returns whether it held."""
        with self._changed:
            grant = self._grants.get(number)
            if grant is None:
                return False
            busy = [resource for resource in grant.resources if resource.busy]
            self._end(grant, reason)
            self._record("lock lost", grant, reason)
            for resource in busy:
                resource.pending = _STOPPING
        self._on_loss(number, reason)
        try:
            self._stop(busy, reason, self._stopped)
        except Exception as error:  # noqa: BLE001 - other locks depend on this same thread
            for resource in busy:
                self._stopped(resource, f"it could not be stopped: {error}")
        return True

    def session_ended(self, session: str, reason: str) -> None:
        """Ends a session and those within it: its locks are lost, and its requests end.

        Its later calls are refused: some may have been under way, or waited for their turn.
        """
        with self._changed:
            self._sessions.ended(session, reason)
            for waiter in self._acquiring:
                if within(waiter.holder.session, session):
                    waiter.dropped = reason
            fallen = [grant.number for grant in self._grants.values() if within(grant.holder.session, session)]
            self._changed.notify_all()
        for number in fallen:
            self.lose(number, reason)

    def session_back(self, session: str) -> None:
        """Records that an unreachable session is back."""
        self._sessions.back(session)

    def session_error(self, sessions: Iterable[str]) -> SessionEnded | None:
        """Which of these has ended, as an error; None if all exist."""
        return self._sessions.session_error(sessions)

    def infos(self) -> list[LockInfo]:
        """The grants that hold, with their waiters."""
        with self._changed:
            now = self._clock()
            return [grant.info(self._epoch, self._container, now, self._waiting) for grant in self._grants.values()]

    def withheld(self) -> list[LockInfo]:
        """Resources that could not be stopped, which no client gets before they are resumed (S14), with number 0."""
        return [withheld(one, self._epoch, self._container) for one in self.resources() if one.unsafe]

    def stops(self) -> list[StopInfo]:
        """The stops that hold resources now (S08, S09)."""
        found = [(one.name, one.estop or one.latch, one.estop is not None) for one in self.resources()]
        return [StopInfo(self._container, name, latch.by, latch.reason, estop) for name, latch, estop in found if latch]

    # --- its end

    def _end(self, grant: Grant, reason: str) -> None:
        self._ended[grant.number] = reason  # first: threads that do not find the grant read this
        del self._grants[grant.number]
        if len(self._ended) > _REMEMBERED:
            del self._ended[next(iter(self._ended))]
        for resource in grant.resources:
            if resource.live == grant.number:
                resource.live, resource.holder = 0, None
        self._changed.notify_all()

    def _record(self, event: str, grant: Grant, reason: str = "") -> None:
        names, holder = [resource.name for resource in grant.resources], grant.holder
        self._audit.note("lock", event, about=names, who=holder.identity, session=holder.session, why=reason)

    def _stopped(self, resource: Resource, problem: str) -> None:
        with self._changed:
            resource.stop_ended(problem)
            if resource.pending is _STOPPING:
                resource.pending = None
            self._changed.notify_all()

    def _rested(self) -> None:
        if self._acquiring:
            with self._changed:
                self._changed.notify_all()

    def expire(self) -> float:
        """Revokes grants whose lease has ended. Returns when the next one may end, by this clock, or infinity."""
        with self._changed:
            now = self._clock()
            expired = [grant.number for grant in self._grants.values() if grant.until <= now]
            soonest = min((grant.until for grant in self._grants.values() if grant.until > now), default=math.inf)
        for number in expired:
            self.lose(number, _LEASE_ENDED)
        return soonest

    def close(self) -> None:
        """Ends every wait. Idempotent."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._leases.cancel(_END_S)


def _stop_nothing(resources: Sequence[Resource], _: str, done: Callable[[Resource, str], None]) -> None:
    for resource in resources:
        done(resource, "")
