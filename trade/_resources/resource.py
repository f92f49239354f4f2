"""Resources, which one client at a time may use, and the fences that protect them until immediately before the wire.

A call is admitted under a permit, which records the locks and stops of its resources at that moment. The driver checks
the permit again immediately before bytes go out: any lock, unlock or stop in between makes it void.
"""

import contextlib
import itertools
import time
from collections.abc import Callable, Generator, Iterable, Sequence
from typing import Final, NamedTuple

from msgspec import Struct, structs

from trade._context.call_context import CallContext, running
from trade._context.sessions import foreign
from trade.errors import LockedByOther, LockLost, MotionStopped, NotStopped, SessionEnded, Stopped
from trade.protocol.messages import Token
from trade.timestamps import clock

_stop_numbers: Final = itertools.count(1).__next__
_permit_ids: Final = itertools.count(-1, -1).__next__
"""Plain Python calls have no call id; their ids are negative."""


class Holder(Struct, frozen=True):
    """The holder of a grant, as errors and `trade.locks` report it."""

    identity: str
    container: str
    session: str
    purpose: str
    since: float
    """``time.time()`` when it was granted."""
    delegates: tuple[str, ...] = ()

    @property
    def owner(self) -> str:
        """``identity/container``, or ``clinic/anna via door`` for a client of another system."""
        return foreign(self.session) or (f"{self.identity}/{self.container}" if self.container else self.identity)


class Latch(NamedTuple):
    """A stop that holds until it is resumed."""

    by: str
    reason: str
    estop: bool = False
    """Whether it was an e-stop; clearing that does not resume."""

    def stopped(self, resource: str, *, estop: bool) -> Stopped:
        """The error of calls on that resource.

        Args:
            resource: its name.
            estop: whether an e-stop is open.
        """
        return Stopped(resource=resource, by=self.by, reason=self.reason, estop=estop, cleared=self.estop and not estop)


class Resource:
    """A physical thing, such as a joint: one client at a time uses it, any client may stop it.

    Its driver creates it, names it in ``resources`` of every provider that moves it, reports ``moving``, and passes
    each command through ``permit``. The container of those providers decides which client may use it.
    """

    __slots__ = (
        *("_moving", "_on_rest", "calls", "coupled", "epoch", "estop", "session_error", "holder", "last_stop", "latch"),
        *("live", "movers", "name", "why_ended", "pending", "stops", "unsafe", "unsafe_at", "used_at", "uses", "why"),
    )

    def __init__(self, name: str, *, coupled: Sequence[str] = ()) -> None:
        self.name: Final = name
        self.coupled: Final = tuple(coupled)
        """Names of resources of the same container that are only locked together with it."""
        self.epoch = ""
        """The epoch of the container that grants its locks."""
        self.why_ended: Callable[[int], str] = _no_grantor
        """Why a grant no longer holds, by the clock of its lease; empty if it holds."""
        self.session_error: Callable[[Iterable[str]], SessionEnded | None] = _no_session_error
        """Which of some sessions has ended, as an error."""
        self.live = 0
        """The number of the grant that holds now; 0 is none."""
        self.holder: Holder | None = None
        self.pending: Holder | None = None
        """The client that waits until its calls and motion have ended: no new call is admitted."""
        self.stops = 0
        self.last_stop = ""
        """Why it was stopped last."""
        self.latch: Latch | None = None
        self.estop: Latch | None = None
        self.why = ""
        """Why it has to stop, for its driver; empty once the driver has begun to stop it."""
        self.unsafe = ""
        """Why it is not granted again: a required stop failed."""
        self.unsafe_at = 0.0
        """``time.time()`` of that failure."""
        self.movers: tuple[str, ...] = ()
        """The sessions that moved it last."""
        self.calls: dict[int, Permit] = {}
        """The admitted calls that have not ended, by call id."""
        self.uses = 0
        """The number of calls under its present lock."""
        self.used_at = 0.0
        self._moving = False
        self._on_rest: Callable[[], None] | None = None

    @property
    def moving(self) -> bool:
        """Whether it moves now, as its driver reports."""
        return self._moving

    @moving.setter
    def moving(self, value: bool) -> None:
        was, self._moving = self._moving, value
        if was and not value:
            self.notify_rest()

    def on_rest(self, callback: Callable[[], None]) -> None:
        """Calls this whenever it comes to rest, and when a call on it ends while a lock waits for that."""
        self._on_rest = callback

    def notify_rest(self) -> None:
        """Makes the waiters for it check again."""
        if self._on_rest is not None:
            self._on_rest()

    def stop(
        self, by: str, sessions: Iterable[str] = (), reason: str = "stop() was called", *, estop: bool = False
    ) -> None:
        """Makes all earlier permits void; a stop by a session other than the mover's or lock owner's latches (S08).

        Args:
            by: who stops, for messages.
            sessions: the stopping client's sessions; none: the resource's driver, whose stops never latch.
            reason: why.
            estop: whether it is an e-stop.
        """
        stopping = set(sessions)
        used = self.holder is not None or self.busy or self.movers
        if stopping and used and not self._is_of(stopping):
            self.latch = Latch(by, reason, estop)  # first: a call admitted under the new number has seen it
        self.why = self.last_stop = reason
        self.stops = _stop_numbers()  # not += 1: one of two concurrent stops would be lost

    def _is_of(self, stopping: set[str]) -> bool:
        """Whether its lock, or all calls that move it, belong to these sessions."""
        if self.holder is not None and self.holder.session in stopping:
            return True
        begun = [permit.sessions for permit in list(self.calls.values())] or [self.movers]
        return all(not stopping.isdisjoint(sessions) for sessions in begun)

    @property
    def sessions(self) -> frozenset[str]:
        """The sessions that move it: of its running calls, and while it moves of the last admitted one.

        While a call is admitted, its resources do not all name its sessions yet; those at rest name an earlier mover.
        """
        still = self.movers if self._moving else ()
        return frozenset(still).union(*(permit.sessions for permit in list(self.calls.values())))

    @property
    def busy(self) -> bool:
        """Whether a call moves it or is about to."""
        return self._moving or bool(self.calls)

    @property
    def guarded(self) -> bool:
        """Whether a client holds it or is about to; read in this order, as a grant holds before it ceases to pend."""
        return self.pending is not None or self.live != 0

    def stop_ended(self, problem: str) -> None:
        """Takes the result of a required stop: after a failed one no client gets it before it is resumed (S14).

        A later successful stop does not undo this: it was not at rest when it had to be.

        Args:
            problem: why it could not be stopped; empty if it was.
        """
        if problem:
            self.unsafe_at, self.unsafe = time.time(), problem  # the time first: readers of the problem report it

    def resume(self) -> None:
        """Lets it move again after a latched stop, and be granted again after a failed one."""
        self.latch = None
        self.unsafe = ""

    def check(self, tokens: Iterable[Token], caller: str, session: str = "") -> None:
        """Checks that a call with these tokens may begin.

        Raises:
            Stopped: a stop latched.
            LockedByOther: another client holds it, or is about to.
            LockLost: the caller has lost its lock.
        """
        latch = self.estop or self.latch
        if latch is not None:
            raise latch.stopped(self.name, estop=self.estop is not None)
        self.check_lock(tokens, caller, session)

    def check_lock(self, tokens: Iterable[Token], caller: str, session: str = "") -> None:
        """The same check for calls that only read, which a stop does not prevent.

        Raises:
            LockedByOther, LockLost: see `check`.
        """
        pending, live, holder, shown = self.pending, self.live, self.holder, False  # in the order of `guarded`
        for token in tokens:
            if token.epoch == self.epoch:
                if reason := self.why_ended(token.number):
                    raise lapsed(self, reason)
                shown = shown or token.number == live
        if live:
            if not shown or holder is None or not (caller == holder.identity or caller in holder.delegates):
                raise locked(self, holder, session)
            self.uses, self.used_at = self.uses + 1, time.time()
        elif pending is not None:
            raise locked(self, pending, session)

    def __repr__(self) -> str:
        return f"<Resource {self.name}>"


def _no_session_error(_: Iterable[str]) -> None:
    return None


def _no_grantor(_: int) -> str:
    return "no container grants its locks"


def lapsed(resource: Resource, reason: str) -> LockLost:
    """The error of calls under a grant that no longer holds."""
    return LockLost(resources=(resource.name,), reason=reason)


def locked(resource: Resource, holder: Holder | None, session: str = "") -> LockedByOther:
    """The error of calls on a resource that another client holds."""
    if holder is None:
        return LockedByOther(resources=(resource.name,), owner="another client")
    return LockedByOther(
        resources=(resource.name,),
        owner=holder.owner,
        purpose=holder.purpose,
        since=holder.since,
        own=holder.session == session,
    )


def not_stopped(resource: Resource, container: str) -> NotStopped:
    """The error of lock requests for a resource that could not be stopped."""
    when = clock(resource.unsafe_at)
    reason, waited_s = f"at {when} ({resource.unsafe})", max(0.0, time.time() - resource.unsafe_at)
    return NotStopped(device=resource.name, bus=container, waited_s=waited_s, reason=reason)


class Permit(Struct, eq=False):
    """The permit of an admitted call: the locks and stops of its resources at that moment."""

    call_id: int
    sessions: tuple[str, ...]
    cancel: Callable[[], None] | None
    """Asks the call to end."""
    fences: list[tuple[Resource, int, int]] = []
    """Each of its resources with the grant and the stop number at admission."""

    def gate(self) -> None:
        """The last check before bytes go out.

        Raises:
            MotionStopped: a stop came after it was admitted.
            LockLost: it was admitted under a lock that no longer holds.
            LockedByOther: it was admitted without a lock, and another client has locked a resource since.
        """
        for resource, live, stops in self.fences:
            if resource.stops != stops:
                latch = resource.estop or resource.latch
                reason = resource.last_stop if latch is None else f"{latch.by}: {latch.reason}"
                raise MotionStopped(device=resource.name, reason=reason)
            if live and ((reason := resource.why_ended(live)) or resource.live != live):
                raise lapsed(resource, reason)
            if resource.live != live:
                raise locked(resource, resource.holder)

    def covers(self, resources: Iterable[Resource]) -> bool:
        """Whether it was admitted for all of these."""
        own = {id(resource) for resource, _, _ in self.fences}
        return all(id(resource) in own for resource in resources)

    def close(self) -> None:
        """Ends the permit with its call."""
        for resource, _, _ in self.fences:
            resource.calls.pop(self.call_id, None)
            if resource.pending is not None:
                resource.notify_rest()


def admit(
    resources: Sequence[Resource],
    call_id: int,
    caller: str,
    tokens: Sequence[Token],
    sessions: tuple[str, ...],
    cancel: Callable[[], None] | None,
) -> Permit:
    """Admits a call to its resources; it counts as running until the permit is closed.

    The order matters: the call is counted first, then the fences are recorded, then checked. So a pending lock sees the
    call or has refused it, and the gate refuses the call after any later change.

    Raises:
        Stopped, LockedByOther, LockLost: see `Resource.check`; the call does not count then.
        SessionEnded: one of its sessions has ended; likewise.
    """
    permitted = Permit(call_id, sessions, cancel)
    try:
        for resource in resources:
            resource.calls[call_id] = permitted
            permitted.fences.append((resource, resource.live, resource.stops))
            if tokens or resource.guarded or resource.latch is not None or resource.estop is not None:
                resource.check(tokens, caller, sessions[0] if sessions else "")
            if (ended := resource.session_error(sessions)) is not None:
                raise ended
    except BaseException as refused:
        permitted.close()
        if isinstance(refused, Stopped):
            refused.others = tuple(one.name for one in resources if one.latch and one.name != refused.resource)
        raise
    for resource in resources:
        resource.movers = sessions
    return permitted


def admitted(resources: Sequence[Resource], context: CallContext) -> Permit:
    """Admits a call that came through the middleware, and stores the permit in its context."""
    ongoing, behalf = context.ongoing, context.behalf
    cancel = None if ongoing is None else ongoing.cancel
    tokens = () if behalf is None else behalf.tokens
    sessions = (context.session,) if behalf is None else (context.session, *behalf.sessions)
    permitted = admit(resources, context.id, context.caller, tokens, sessions, cancel)
    structs.force_setattr(context, "permit", permitted)
    return permitted


@contextlib.contextmanager
def permit(resources: Sequence[Resource]) -> Generator[Permit, None, None]:
    """The running code's permit for these resources; a driver checks its `gate` immediately before bytes go out.

    Within a service that needs them it is that call's permit. Anywhere else it is a plain Python call, which counts as
    a call without a lock (S15).

    Raises:
        Stopped, LockedByOther: see `Resource.check`.
    """
    call = running.get()
    own = None if call is None else call.permit
    if isinstance(own, Permit) and own.covers(resources):
        yield own
        return
    sessions = () if call is None else call.sessions
    fresh = admit(resources, _permit_ids(), "", (), sessions, None)
    try:
        yield fresh
    finally:
        fresh.close()
