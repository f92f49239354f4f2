"""Resources: what one at a time may use, and the fences that hold to the last place before the wire.

A call is admitted under what holds for its resources at that moment, its permit. Whoever drives the hardware looks at
the permit once more right before bytes go out: any lock, unlock or stop in between makes it void.
"""

import contextlib
import itertools
import time
from collections.abc import Callable, Generator, Iterable, Sequence
from typing import Final, NamedTuple

from msgspec import Struct, structs

from trade._context.call_context import CallContext, running
from trade._context.sessions import foreign
from trade._protocol.messages import Token
from trade._timestamps import clock
from trade.errors import LockedByOther, LockLost, MotionStopped, NotStopped, SessionEnded, Stopped

__all__ = ["Permit", "Resource", "permit"]

_stop_numbers: Final = itertools.count(1).__next__
_permit_ids: Final = itertools.count(-1, -1).__next__
"""Plain Python calls have no id of the system's; theirs are below zero."""


class Holder(Struct, frozen=True):
    """Whose grant it is, as errors and `trade.locks` tell it."""

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
    """A stop that holds until somebody resumes."""

    by: str
    reason: str
    estop: bool = False
    """Whether an e-stop did it; clearing that does not resume."""

    def stopped(self, resource: str, *, estop: bool) -> Stopped:
        """The error of who comes to that resource.

        Args:
            resource: its name.
            estop: whether an e-stop is open.
        """
        return Stopped(resource=resource, by=self.by, reason=self.reason, estop=estop, cleared=self.estop and not estop)


class Resource:
    """Something physical, such as a joint: used by one at a time, stopped by anybody.

    Whoever drives it makes it, names it in ``resources`` of every provider that moves it, reports ``moving``, and
    passes each command through ``permit``. The container those providers are registered in judges who may use it.
    """

    __slots__ = (
        *("_moving", "_rested", "calls", "coupled", "epoch", "estop", "gone", "holder", "latch", "live"),
        *("movers", "name", "over", "pending", "stops", "unsafe", "unsafe_at", "used_at", "uses", "why"),
    )

    def __init__(self, name: str, *, coupled: Sequence[str] = ()) -> None:
        self.name: Final = name
        self.coupled: Final = tuple(coupled)
        """Names of resources of the same container that are only locked together with it."""
        self.epoch = ""
        """Of the container that judges."""
        self.over: Callable[[int], str] = _every_grant_is_over
        """Why a grant of that container holds no more, by the clock of its leases; empty if it holds."""
        self.gone: Callable[[Iterable[str]], SessionEnded | None] = _all_are_there
        """Which of some sessions has ended."""
        self.live = 0
        """The grant that holds now; 0 is none."""
        self.holder: Holder | None = None
        self.pending: Holder | None = None
        """For whom it is being emptied: no new call is admitted."""
        self.stops = 0
        self.latch: Latch | None = None
        self.estop: Latch | None = None
        self.why = ""
        """Why it is to stop, for whoever drives it; empty once that has begun to."""
        self.unsafe = ""
        """Why it is not granted on: it could not be stopped when it had to be."""
        self.unsafe_at = 0.0
        """``time.time()`` when that was."""
        self.movers: tuple[str, ...] = ()
        """The sessions for which it was moved last."""
        self.calls: dict[int, Permit] = {}
        """What is admitted and has not ended, by call id."""
        self.uses = 0
        """Calls under the lock that holds."""
        self.used_at = 0.0
        self._moving = False
        self._rested: Callable[[], None] | None = None

    @property
    def moving(self) -> bool:
        """Whether it moves now, as far as whoever drives it knows."""
        return self._moving

    @moving.setter
    def moving(self, value: bool) -> None:
        was, self._moving = self._moving, value
        if was and not value:
            self.tell_rest()

    def on_rest(self, tell: Callable[[], None]) -> None:
        """Have this called whenever it comes to rest, and when a call on it ends while it is being emptied."""
        self._rested = tell

    def tell_rest(self) -> None:
        """Have those who wait for it look again."""
        if self._rested is not None:
            self._rested()

    def stop(
        self, by: str, sessions: Iterable[str] = (), reason: str = "stop() was called", *, estop: bool = False
    ) -> None:
        """Void everything admitted so far; by a session other than the motion's own or the lock owner's, latch (S08).

        Args:
            by: who stops, for messages.
            sessions: of who stops; none: whoever drives the resource, which never latches.
            reason: why.
            estop: whether it is an e-stop.
        """
        asking = set(sessions)
        used = self.holder is not None or self.busy or self.movers
        if asking and used and not self._is_of(asking):
            self.latch = Latch(by, reason, estop)  # first: who is let in under the new number has seen it
        self.why = reason
        self.stops = _stop_numbers()  # not += 1: of two at once one would be lost

    def _is_of(self, asking: set[str]) -> bool:
        """Whether all that moves it belongs to these, or its lock does."""
        if self.holder is not None and self.holder.session in asking:
            return True
        begun = [permit.sessions for permit in list(self.calls.values())] or [self.movers]
        return all(not asking.isdisjoint(sessions) for sessions in begun)

    @property
    def sessions(self) -> frozenset[str]:
        """For whom it moves: of the calls that run, and of the last one that was let in."""
        return frozenset(self.movers).union(*(permit.sessions for permit in list(self.calls.values())))

    @property
    def busy(self) -> bool:
        """Whether something moves it or is about to."""
        return self._moving or bool(self.calls)

    @property
    def guarded(self) -> bool:
        """Whether somebody has it or is about to; asked in this order, as a grant holds before it ceases to pend."""
        return self.pending is not None or self.live != 0

    def stop_ended(self, problem: str) -> None:
        """Note how a stop that had to be ended: with a problem nobody gets it before somebody resumes it (S14).

        A later one that went well takes nothing back: it was not seen to rest when it had to.

        Args:
            problem: why it could not be stopped; empty if it was.
        """
        if problem:
            self.unsafe_at, self.unsafe = time.time(), problem  # the time first: who sees the problem tells it

    def resume(self) -> None:
        """Let it move again after a stop that latched, and be granted again after one that failed."""
        self.latch = None
        self.unsafe = ""

    def check(self, tokens: Iterable[Token], caller: str, session: str = "") -> None:
        """Whether a call with these tokens may begin.

        Raises:
            Stopped: a stop latched.
            LockedByOther: somebody else has it, or it is being emptied for somebody else.
            LockLost: the caller had it.
        """
        latch = self.estop or self.latch
        if latch is not None:
            raise latch.stopped(self.name, estop=self.estop is not None)
        self.check_lock(tokens, caller, session)

    def check_lock(self, tokens: Iterable[Token], caller: str, session: str = "") -> None:
        """The same for what only reads, which goes on after a stop.

        Raises:
            LockedByOther, LockLost: see `check`.
        """
        pending, live, holder, shown = self.pending, self.live, self.holder, False  # in the order of `guarded`
        for token in tokens:
            if token.epoch == self.epoch:
                if why := self.over(token.number):
                    raise lapsed(self, why)
                shown = shown or token.number == live
        if live:
            if not shown or holder is None or not (caller == holder.identity or caller in holder.delegates):
                raise locked(self, holder, session)
            self.uses, self.used_at = self.uses + 1, time.time()
        elif pending is not None:
            raise locked(self, pending, session)

    def __repr__(self) -> str:
        return f"<Resource {self.name}>"


def _all_are_there(_: Iterable[str]) -> None:
    return None


def _every_grant_is_over(_: int) -> str:
    return "nobody judges locks of it"


def lapsed(resource: Resource, why: str) -> LockLost:
    """The error of who comes under a grant that holds no more."""
    return LockLost(resources=(resource.name,), reason=why)


def locked(resource: Resource, holder: Holder | None, session: str = "") -> LockedByOther:
    """The error of who comes to a resource that another one has."""
    if holder is None:
        return LockedByOther(resources=(resource.name,), owner="somebody")
    return LockedByOther(
        resources=(resource.name,),
        owner=holder.owner,
        purpose=holder.purpose,
        since=holder.since,
        own=holder.session == session,
    )


def not_stopped(resource: Resource, container: str) -> NotStopped:
    """The error of who wants what could not be stopped."""
    when = clock(resource.unsafe_at)
    reason, waited_s = f"at {when} ({resource.unsafe})", max(0.0, time.time() - resource.unsafe_at)
    return NotStopped(device=resource.name, bus=container, waited_s=waited_s, reason=reason)


class Permit(Struct, eq=False):
    """What a call was admitted under."""

    call_id: int
    sessions: tuple[str, ...]
    cancel: Callable[[], None] | None
    """Asks what runs under it to end."""
    fences: list[tuple[Resource, int, int]] = []
    """Of each of its resources the grant and the number of stops."""

    def gate(self) -> None:
        """The last look before bytes go out.

        Raises:
            MotionStopped: a stop came after it was admitted.
            LockLost: it was admitted under a lock that does not hold any more.
            LockedByOther: it was admitted without a lock, and now somebody has it.
        """
        for resource, live, stops in self.fences:
            if resource.stops != stops:
                latch = resource.estop or resource.latch
                reason = "it was stopped" if latch is None else f"{latch.by}: {latch.reason}"
                raise MotionStopped(device=resource.name, reason=reason)
            if live and ((why := resource.over(live)) or resource.live != live):
                raise lapsed(resource, why)
            if resource.live != live:
                raise locked(resource, resource.holder)

    def covers(self, resources: Iterable[Resource]) -> bool:
        """Whether all of these are among what it was admitted for."""
        own = {id(resource) for resource, _, _ in self.fences}
        return all(id(resource) in own for resource in resources)

    def close(self) -> None:
        """The call has ended."""
        for resource, _, _ in self.fences:
            resource.calls.pop(self.call_id, None)
            if resource.pending is not None:
                resource.tell_rest()


def admit(
    resources: Sequence[Resource],
    call_id: int,
    caller: str,
    tokens: Sequence[Token],
    sessions: tuple[str, ...],
    cancel: Callable[[], None] | None,
) -> Permit:
    """Let a call begin on its resources; it is counted until the permit is closed.

    It is counted first, what holds is noted then, and checked last: whoever empties a resource either sees it or has
    refused it, and whatever comes after the check voids it at its gate.

    Raises:
        Stopped, LockedByOther, LockLost: see `Resource.check`; nothing is counted then.
        SessionEnded: one for whom it is made is not there any more; likewise.
    """
    permitted = Permit(call_id, sessions, cancel)
    try:
        for resource in resources:
            resource.calls[call_id] = permitted
            permitted.fences.append((resource, resource.live, resource.stops))
            if tokens or resource.guarded or resource.latch is not None or resource.estop is not None:
                resource.check(tokens, caller, sessions[0] if sessions else "")
            if (ended := resource.gone(sessions)) is not None:
                raise ended
    except BaseException:
        permitted.close()
        raise
    for resource in resources:
        resource.movers = sessions
    return permitted


def admitted(resources: Sequence[Resource], context: CallContext) -> Permit:
    """Admit a call that came through the middleware, which has the permit then."""
    ongoing, behalf = context.ongoing, context.behalf
    cancel = None if ongoing is None else ongoing.cancel
    tokens = () if behalf is None else behalf.tokens
    sessions = (context.session,) if behalf is None else (context.session, *behalf.sessions)
    permitted = admit(resources, context.id, context.caller, tokens, sessions, cancel)
    structs.force_setattr(context, "permit", permitted)
    return permitted


@contextlib.contextmanager
def permit(resources: Sequence[Resource]) -> Generator[Permit, None, None]:
    """For who drives hardware: what the running code may do to these, to be looked at right before bytes go out.

    Within a service that needs them it is that call's permit. Anywhere else it is a plain Python call, which counts as
    one without a lock (S15).

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
