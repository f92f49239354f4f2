"""The lock table of a container: who has which of its resources, for how long, and who comes next.

All of it is this container's own: grants are made here, leases run on this clock, fences fall here. The other side of a
lock, who asks and renews, is `_locks.lease_client`.
"""

import math
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Final

from msgspec import structs

from trade._audit.events import Audit
from trade._context.sessions import EndedSessions, foreign, within
from trade._protocol.messages import Token
from trade._resources.grants import Grant, Granted, LockInfo, LockRequest, Waiter, withheld
from trade._resources.leases import Leases
from trade._resources.resource import Holder, Latch, Resource, locked, not_stopped
from trade.errors import LockedByOther, NotStopped, ServiceGone, SessionEnded, TradeError

_STOPPING: Final = Holder("trade", "", "", "stopping what moved under a lock that was lost", 0.0)

_REMEMBERED: Final = 256
"""So many grants that ended are known with the reason."""
_LEASE_ENDED: Final = "its lease ended"

Stop = Callable[[Sequence[Resource], str, Callable[[Resource, str], None]], None]
"""Stops resources for a reason, without waiting; tells of each when it is over, and why if it could not be done."""


class LockTable:
    """The resources of one container."""

    def __init__(
        self,
        epoch: str,
        container: str,
        clock: Callable[[], float] = time.monotonic,
        audit: Audit | None = None,
    ) -> None:
        self._audit = audit or Audit()
        self._epoch = epoch
        self._container = container
        self._stop: Stop = _leave_it
        self._told: Callable[[int, str], None] = lambda _number, _reason: None
        self._clock = clock
        self._resources: dict[str, tuple[Resource, int]] = {}
        """By name, with the number of services that use it."""
        self._grants: dict[int, Grant] = {}
        self._ended: dict[int, str] = {}
        """Why the last few grants ended."""
        self._sessions = EndedSessions()
        self._waiting: list[Waiter] = []
        """For their turn, next first."""
        self._acquiring: list[Waiter] = []
        """For their turn or for what still runs."""
        self._count = 0
        self._changed = threading.Condition(threading.RLock())
        self._leases = Leases(self.expire, clock)
        self._closed = False
        self._estop: Latch | None = None

    def stop_with(self, stop: Stop) -> None:
        """How to stop what moves under a lock that is lost."""
        self._stop = stop

    def tell_of_losses(self, told: Callable[[int, str], None]) -> None:
        """Have this called, and not kept waiting, with each grant that is taken away, and why."""
        self._told = told

    # --- resources

    def adopt(self, named: Resource | str) -> Resource:
        """The resource of that name, made if it is new; given back by `drop`.

        Raises:
            ValueError: another object stands for that name already.
        """
        name = named if isinstance(named, str) else named.name
        with self._changed:
            known, uses = self._resources.get(name, (None, 0))
            resource = known or (named if isinstance(named, Resource) else Resource(name))
            if isinstance(named, Resource) and resource is not named:
                raise ValueError(f"resource {name} is another object already; share one trade.Resource")
            if known is None:  # what is offered anew is nobody's
                resource.live, resource.holder = 0, None
            resource.epoch, resource.over, resource.gone = self._epoch, self.over, self._sessions.gone
            resource.estop = self._estop
            resource.on_rest(self._rested)
            self._resources[name] = (resource, uses + 1)
            return resource

    def estop(self, latch: Latch | None) -> None:
        """Latch every resource, those to come, too, or none any more."""
        with self._changed:
            self._estop = latch
            for resource, _ in self._resources.values():
                resource.estop = latch

    def drop(self, resource: Resource) -> None:
        """One service less uses it. With the last one it is gone: locks of it are lost, who waits for it is refused."""
        with self._changed:
            known, uses = self._resources[resource.name]
            if uses > 1:
                self._resources[resource.name] = (known, uses - 1)
                return
            del self._resources[resource.name]
            for waiter in self._acquiring:
                if resource in waiter.resources:
                    waiter.gone = f"{resource.name} is no longer offered"
            self._changed.notify_all()
        self.lose(resource.live, f"{resource.name} is no longer offered")

    def resources(self) -> list[Resource]:
        """All of them, by name."""
        with self._changed:
            return [self._resources[name][0] for name in sorted(self._resources)]

    def named(self, names: Iterable[str]) -> tuple[Resource, ...]:
        """Those of these names and what is coupled to them, in the order all lock in.

        Raises:
            ServiceGone: one is not here (any more).
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
        """Wait for one's turn, then for what still runs, then have them all.

        Args:
            names: of resources; what is coupled to them comes with them.
            holder: who asks.
            terms: how.
            tokens: locks the asking call is made under; what they hold is not asked for again.
            calls: the asking chain, which is not waited for.

        Raises:
            LockedByOther: not within the times given; nothing is held then.
            NotStopped: one could not be stopped when it had to be, and is given to nobody.
            ServiceGone: one is not here.
            SessionEnded: who asks is not there any more.
        """
        mine = set(tokens)
        resources = tuple(one for one in self.named(names) if Token(self._epoch, one.live) not in mine)
        if not resources:
            return Granted(None, ())
        asked = self._clock()
        with self._changed:
            if (ended := self.gone((holder.session,))) is not None:
                raise ended
            self._count += 1
            waiter = Waiter((-terms.priority, self._count), resources, holder, frozenset(calls))
            self._acquiring.append(waiter)
            try:
                self._take_turn(waiter, asked + terms.wait_s)
                return self._empty_and_grant(waiter, terms, asked)
            finally:
                self._acquiring.remove(waiter)

    def _empty_and_grant(self, waiter: Waiter, terms: LockRequest, asked: float) -> Granted:
        try:
            self._drain(waiter, asked + terms.wait_s)
            return self._grant(waiter, terms, asked)
        finally:
            for resource in waiter.resources:
                resource.pending = None
            self._changed.notify_all()

    def _take_turn(self, waiter: Waiter, until: float) -> None:
        """Wait until nobody has any of them and nobody waits before us for any; they are ours to empty then."""
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
            if shared is not None:  # in strict order, so that every wait is bounded by those before it
                return locked(shared, earlier.holder, waiter.holder.session)
        return None

    def _unsafe(self, waiter: Waiter) -> NotStopped | None:
        return next((not_stopped(one, self._container) for one in waiter.resources if one.unsafe), None)

    def _drain(self, waiter: Waiter, until: float) -> None:
        while (running := self._running(waiter)) is not None:
            owner = ", ".join(running.movers) or "somebody"
            purpose = "a call or a motion that has not ended"
            self._wait(waiter, until, LockedByOther(resources=(running.name,), owner=owner, purpose=purpose))
            if (unsafe := self._unsafe(waiter)) is not None:  # whoever moved it has gone meanwhile, and it went on
                raise unsafe

    def _wait(self, waiter: Waiter, until: float, obstacle: TradeError) -> None:
        left = until - self._clock()
        if left <= 0 or waiter.gone or self._closed or isinstance(obstacle, NotStopped):
            raise obstacle
        self._changed.wait(left)

    def _running(self, waiter: Waiter) -> Resource | None:
        """One of them that is still in use by others than the asking chain."""
        for resource in waiter.resources:
            others = [call for call in list(resource.calls) if call not in waiter.calls]
            if others or (resource.moving and not resource.calls):
                return resource
        return None

    def _grant(self, waiter: Waiter, terms: LockRequest, asked: float) -> Granted:
        if waiter.gone:
            raise ServiceGone(service=", ".join(one.name for one in waiter.resources), reason=waiter.gone)
        self._count += 1
        now, number = self._clock(), self._count
        holder = structs.replace(waiter.holder, since=time.time())
        grant = Grant(number, waiter.resources, holder, terms.lease_s, now + terms.lease_s)
        self._grants[number] = grant
        for resource in waiter.resources:
            resource.holder, resource.live = holder, number
            resource.uses, resource.used_at = 0, 0.0
        self._leases.look_by(grant.until)
        self._note("locked", grant, holder.purpose and f"for {holder.purpose}")
        return Granted(Token(self._epoch, number), tuple(one.name for one in grant.resources), now - asked)

    # --- while it is held

    def renew(self, numbers: Iterable[int], identity: str) -> list[int]:
        """Let leases begin anew; returns those that still hold."""
        with self._changed:
            now = self._clock()
            held = [self._grants[number] for number in numbers if number in self._grants]
            own = [grant for grant in held if grant.holder.identity == identity and grant.until > now]
            for grant in own:
                grant.until = now + grant.lease_s
            return [grant.number for grant in own]

    def over(self, number: int) -> str:
        """Why a grant holds no more; empty if it holds."""
        grant = self._grants.get(number)
        if grant is None:
            return self._ended.get(number, "it ended long ago")
        return "" if grant.until > self._clock() else _LEASE_ENDED

    def may_use(self, number: int, identity: str) -> bool:
        """Whether a grant holds and somebody of that identity may show it."""
        grant = self._grants.get(number)
        return grant is not None and (identity == grant.holder.identity or identity in grant.holder.delegates)

    def release(self, number: int, identity: str) -> bool:
        """Give it back; what its owner left moving goes on, and the next one waits for it. Returns whether it held."""
        with self._changed:
            grant = self._grants.get(number)
            if grant is None or grant.holder.identity != identity:
                return False
            self._end(grant, "it was given back")
            self._note("unlocked", grant)
            return True

    def retire(self, number: int, reason: str) -> Callable[[], None] | None:
        """End a grant so that nobody is let in any more to what it holds; None if it has ended.

        For what is about to be dropped: there is no moment in which it is free. Returns what frees it after all.
        """
        with self._changed:
            grant = self._grants.pop(number, None)
            if grant is None:
                return None
            self._ended[number] = reason
            self._note("lock lost", grant, reason)

        def free() -> None:
            with self._changed:
                for resource in grant.resources:
                    if resource.live == number:
                        resource.live, resource.holder = 0, None
                self._changed.notify_all()

        return free

    def lose(self, number: int, reason: str) -> bool:
        """Take it away: what moves under it stops, and only then it is given on. Returns whether it held."""
        with self._changed:
            grant = self._grants.get(number)
            if grant is None:
                return False
            busy = [resource for resource in grant.resources if resource.busy]
            self._end(grant, reason)
            self._note("lock lost", grant, reason)
            for resource in busy:
                resource.pending = _STOPPING
        self._told(number, reason)
        try:
            self._stop(busy, reason, self._stopped)
        except Exception as error:  # noqa: BLE001 - other locks depend on this very thread
            for resource in busy:
                self._stopped(resource, f"it could not be stopped: {error}")
        return True

    def session_ended(self, session: str, reason: str) -> None:
        """Nobody of that session (or of one within it) is there any more: its locks fall, its waiting ends.

        What comes from it later is refused: a call may have been under way, or have waited for its turn.
        """
        with self._changed:
            self._sessions.ended(session, reason)
            for waiter in self._acquiring:
                if within(waiter.holder.session, session):
                    waiter.gone = reason
            fallen = [grant.number for grant in self._grants.values() if within(grant.holder.session, session)]
            self._changed.notify_all()
        for number in fallen:
            self.lose(number, reason)

    def session_back(self, session: str) -> None:
        """It could not be reached, and is there again."""
        self._sessions.back(session)

    def gone(self, sessions: Iterable[str]) -> SessionEnded | None:
        """Which of these has ended, as an error; None if all are there."""
        return self._sessions.gone(sessions)

    def infos(self) -> list[LockInfo]:
        """What is held, and who waits."""
        with self._changed:
            now = self._clock()
            return [grant.info(self._epoch, self._container, now, self._waiting) for grant in self._grants.values()]

    def withheld(self) -> list[LockInfo]:
        """What nobody gets before it is resumed, as it could not be stopped (S14): of "nobody", with number 0."""
        return [withheld(one, self._epoch, self._container) for one in self.resources() if one.unsafe]

    # --- its end

    def _end(self, grant: Grant, reason: str) -> None:
        self._ended[grant.number] = reason  # first: who does not find the grant looks here
        del self._grants[grant.number]
        if len(self._ended) > _REMEMBERED:
            del self._ended[next(iter(self._ended))]
        for resource in grant.resources:
            if resource.live == grant.number:
                resource.live, resource.holder = 0, None
        self._changed.notify_all()

    def _note(self, what: str, grant: Grant, why: str = "") -> None:
        names, holder = [resource.name for resource in grant.resources], grant.holder
        who = foreign(holder.session) or holder.identity
        self._audit.note("lock", what, about=names, who=who, session=holder.session, why=why)

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
        """Take away what outlived its lease. Returns when the next one may end, as this clock counts; or infinity."""
        with self._changed:
            now = self._clock()
            over = [grant.number for grant in self._grants.values() if grant.until <= now]
            soonest = min((grant.until for grant in self._grants.values() if grant.until > now), default=math.inf)
        for number in over:
            self.lose(number, _LEASE_ENDED)
        return soonest

    def close(self) -> None:
        """End every wait. Idempotent."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._leases.close()


def _leave_it(resources: Sequence[Resource], _: str, done: Callable[[Resource, str], None]) -> None:
    for resource in resources:
        done(resource, "")
