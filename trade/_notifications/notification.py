"""Notifications: when an event occurs, and a condition holds, make a call."""

import contextlib
import logging
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from enum import Enum
from typing import Any, Final

from msgspec import Struct

from trade._calls.client import CallClient
from trade._calls.handle import Handle
from trade._context.sessions import Session
from trade._notifications.events import StateEvent
from trade._notifications.triggers import Action, Target, TriggerSpec, text_of
from trade._registry.registry import Record
from trade._threads.scheduler import Scheduler
from trade.errors import ConfigurationError
from trade.transport.wait_clock import WaitClock

_logger = logging.getLogger("trade")

_SINGLE: Final = ("at", "after", "once")
_POLL_NS: Final = 1_000_000_000
"""How often the wall clock is checked: it may be set."""


class State(str, Enum):
    """The state of a notification."""

    WAITING = "waiting"
    """Waits for ``when`` to hold."""
    STANDING = "standing"
    ENDED = "ended"
    """It has fired for the last time, or its time has passed."""
    CANCELLED = "cancelled"


class NotificationInfo(Struct, frozen=True, kw_only=True):
    """The public description of one notification."""

    id: str
    occasion: str
    """The event, such as ``every 10 s``."""
    call: str
    """The service that it calls, as text."""
    condition: str
    owner: str
    """The session of its owner."""
    container: str
    """The container that it runs in."""
    state: str
    """``waiting`` for its ``when``, ``standing``, ``ended`` or ``cancelled``."""
    fired: int
    failures: int
    merged: int
    """Ticks left out because the call of an earlier one still ran."""
    last_error: str
    detached: bool
    """Whether it outlives its owner."""


class Notification(ABC):
    """A standing request for a call; it ends when it has fired for the last time, is cancelled, or its owner ends."""

    def __init__(self, name: str, text: str) -> None:
        self.id: Final = name
        """An id that is unique in the system."""
        self._text = text

    @abstractmethod
    def info(self) -> NotificationInfo:
        """Its current state."""

    @property
    def active(self) -> bool:
        """Whether it can still fire."""
        return self.info().state in (State.WAITING, State.STANDING)

    @abstractmethod
    def cancel(self) -> None:
        """End it; a running call finishes. Idempotent."""

    @abstractmethod
    def detach(self) -> None:
        """Let it outlive its owner; it then lasts until it is cancelled.

        Raises:
            ConfigurationError: it runs in the container that requested it, and ends with it.
        """

    def __repr__(self) -> str:
        return f"<Notification {self._text}>"


class Owner(Struct, frozen=True):
    """The owner of a notification."""

    session: str
    identity: str = ""
    """The owner's identity if it is in another container: checked again at each call made for it."""
    acts_as: Session | None = None
    """The session in which its calls are made."""


class ActiveNotification(Notification):
    """A notification that runs in this container, on the scheduler: never twice at once."""

    def __init__(
        self,
        name: str,
        terms: TriggerSpec,
        call: Target,
        if_: Target | None,
        when: Target | None,
        owner: Owner,
        client: CallClient,
        ended: Callable[["ActiveNotification"], None],
        failed: Callable[["ActiveNotification", str], None],
    ) -> None:
        super().__init__(name, str(terms))
        self.owner: Final = owner
        self.terms: Final = terms
        self._call = call
        self._if = if_
        self._when = when
        self._client = client
        self._on_ended = ended
        self._on_failed = failed
        self.detached = False
        self._state = State.STANDING if when is None else State.WAITING
        self._due_ns: int | None = None
        """The next time of ``after`` and ``every``."""
        self._held = False
        """Whether the condition held at the last tick."""
        self._reports: deque[Handle | StateEvent] = deque()
        """Services that came, went or changed since the last call, or events since then."""
        self._fired = self._failures = self._merged = 0
        self._last_error = ""
        self._logged: set[tuple[str, str]] = set()
        """Failures already reported: the part that failed, and its error."""
        self._cancel_due: Callable[[], None] = lambda: None
        self._clock = WaitClock()

    # --- life cycle

    def begin(self, scheduler: Scheduler) -> Callable[[int], None]:
        """Start it; returns the function that schedules it again."""
        self._clock = scheduler.clock
        due = scheduler.begin(self._act, self._clock.now_ns())
        self._cancel_due = due.cancel
        return due.at

    @property
    def active(self) -> bool:
        return self._state in (State.WAITING, State.STANDING)

    def info(self) -> NotificationInfo:
        conditions = [("if", self._if), ("when", self._when)]
        return NotificationInfo(
            id=self.id,
            occasion=str(self.terms),
            call=text_of(self._call),
            condition=", ".join(f"{word} {text_of(target)}" for word, target in conditions if target is not None),
            owner=self.owner.session,
            container=self._client.name,
            state=self._state.value,
            fired=self._fired,
            failures=self._failures,
            merged=self._merged,
            last_error=self._last_error,
            detached=self.detached,
        )

    def cancel(self) -> None:
        self._end(State.CANCELLED)

    def detach(self) -> None:
        if not self.owner.identity:
            problem = (
                f"it runs in container {self._client.name}, which requested it, and ends with that; "
                "request it with host= another container"
            )
            raise ConfigurationError(where=repr(self), problem=problem)
        self.detached = True

    def _end(self, state: State) -> None:
        if self.active:
            self._state = state
            self._cancel_due()
            self._on_ended(self)

    # --- firing

    def concerns(self, record: Record) -> bool:
        """Whether the notification is about a service."""
        assert self.terms.constraint is not None  # noqa: S101
        return self.terms.constraint.matches(record)

    def add(self, event: Handle | StateEvent) -> None:
        """Include a service or an event in the report of the next run."""
        self._reports.append(event)

    def _act(self) -> int | None:
        now = self._clock.now_ns()
        if self._state is State.WAITING:
            if not self._holds(self._when):
                return now + int(self.terms.poll_s * 1e9)
            if not self.active:  # cancelled meanwhile
                return None
            self._state = State.STANDING
        if self._state is not State.STANDING:
            return None
        match self.terms.occasion:
            case "joined" | "left" | "changed" | "occurred":
                return self._report()
            case "every":
                return self._tick(now)
            case "at":
                left_ns = int((self.terms.at - self._clock.time()) * 1e9)
                return now + min(left_ns, _POLL_NS) if left_ns > 0 else self._once()
            case "after":
                self._due_ns = self._due_ns or now + int(self.terms.s * 1e9)
                return self._due_ns if self._due_ns > now else self._once()
            case "once":
                return self._once()

    def _once(self) -> None:
        self._fire()
        self._end(State.ENDED)

    def _tick(self, now: int) -> int:
        period = int(self.terms.s * 1e9)
        if self._due_ns is None:
            self._due_ns = now + period
            return self._due_ns
        if self._due_ns <= now:
            self._fire()
            self._due_ns += period
            missed = max(0, (self._clock.now_ns() - self._due_ns) // period)
            self._merged += missed
            self._due_ns += missed * period
        return self._due_ns

    def _report(self) -> None:
        while self._reports and self._state is State.STANDING:
            self._fire(self._reports.popleft())

    def _fire(self, *given: Handle | StateEvent) -> None:
        if self._if is not None:
            held, before = self._holds(self._if), self._held
            self._held = held
            if not held or (self.terms.edge and before):
                return
        if not self.active:
            return
        try:
            self._do(self._call, *given)
            self._fired += 1
        except BaseException as error:  # noqa: BLE001 - an error of a callback ends nothing
            self._failed("call", self._call, error)

    def _holds(self, condition: Target | None) -> bool:
        """Whether a condition holds; one that fails does not."""
        assert condition is not None  # noqa: S101
        try:
            held = self._do(condition)
            if not isinstance(held, bool):
                problem = f"a condition returns True or False, not {held!r}"
                raise ConfigurationError(where=text_of(condition), problem=problem)
        except BaseException as error:  # noqa: BLE001
            self._failed("condition", condition, error)
            return False
        return held

    def _do(self, target: Target, *given: Handle | StateEvent) -> Any:
        acts_as = self.owner.acts_as
        with contextlib.nullcontext() if acts_as is None else acts_as.use():
            if not isinstance(target, Action):
                return target(*given)
            handle = target.handle
            if handle is None:
                assert target.constraint is not None  # noqa: S101
                handle = self._client.find(target.constraint, wait_s=0)
            if self.owner.identity:
                self._client.require_call(self.owner.identity, handle)
            return handle(*given, *target.args, **target.kwargs)

    def _failed(self, part: str, target: Target, error: BaseException) -> None:
        self._failures += 1
        kind = type(error).__name__
        self._last_error = f"{kind}: {error}"
        if (part, kind) in self._logged:  # the same error again is not news, whatever numbers its text has
            return
        self._logged.add((part, kind))
        over = self._state is not State.WAITING and self.terms.occasion in _SINGLE
        stays = "" if over else "; it stays attached, and this kind of error is logged once"
        text = "the %s of %r failed (%s, id %s)%s: %s"
        _logger.warning(text, part, self, text_of(target), self.id, stays, self._last_error)
        self._on_failed(self, self._last_error)
