"""The call context: the caller, the deadline and the session of the served call; it also reports progress."""

import time
from collections.abc import Callable
from contextvars import ContextVar
from typing import Any, Final, Protocol

from msgspec import Struct

from trade._context.active_calls import ActiveCall
from trade.errors import Cancelled
from trade.protocol.keys import client_of
from trade.protocol.messages import Behalf, Token

_MOST_EVENTS: Final = 100
_ANSWER_S: Final = 0.3
"""The time reserved for making an answer and for its way back."""


def outer_of(call_id: int, behalf: Behalf | None) -> int:
    """The id of the outermost call that led to a call with this id."""
    return behalf.calls[-1] if behalf is not None and behalf.calls else call_id


class Permitted(Protocol):
    """The permit that a call was admitted under; see `trade.Permit`."""

    def gate(self) -> None: ...


class CallContext(Struct, frozen=True, gc=False):
    """One call, seen from inside the service."""

    id: int
    """Unique in the system."""
    service: str
    caller: str
    """The caller's identity."""
    session: str
    """The session on whose behalf this runs; its motion belongs to that session."""
    expires_ns: int | None
    """``time.monotonic_ns()`` of this process after which nothing may begin; None if being late is harmless."""
    chain: tuple[str, ...] = ()
    """The services whose calls led to this one, outermost first."""

    ongoing: ActiveCall | None = None
    """The middleware's own record of it."""
    behalf: Behalf | None = None
    """The context that the call inherited; its nested calls inherit it, too."""
    permit: Permitted | None = None
    """The permit for the resources of its service."""
    events: list[tuple[int, str]] | None = None
    """Its trace events, with times of ``time.monotonic_ns()``; None if it is not traced."""

    @property
    def asker(self) -> str:
        """The caller, and the client that it acts for, as text for people: ``page for anna``."""
        client = client_of(self.session)
        return f"{self.caller} for {client}" if client else self.caller

    @property
    def sessions(self) -> tuple[str, ...]:
        """The sessions for which it runs, nearest first: its motion stops when one of them ends."""
        return (self.session,) if self.behalf is None else (self.session, *self.behalf.sessions)

    @property
    def outer_id(self) -> int:
        """The id of the outermost call, in any process; all calls that it led to share it."""
        return outer_of(self.id, self.behalf)

    @property
    def tokens(self) -> tuple[Token, ...]:
        """The locks under which it runs."""
        return () if self.behalf is None else self.behalf.tokens

    @property
    def cancelled(self) -> bool:
        """Whether its caller has cancelled it; ending it is up to the provider."""
        return self.ongoing is not None and self.ongoing.cancelled

    def wait_cancelled(self, timeout_s: float | None = None) -> bool:
        """Waits until its caller cancels it, at most this long, and never beyond its deadline.

        Returns:
            Whether it was cancelled.
        """
        left_s = self.remaining_s
        allowed_s = left_s if timeout_s is None else timeout_s if left_s is None else min(timeout_s, left_s)
        if self.ongoing is not None:
            return self.ongoing.wait_cancelled(allowed_s)
        time.sleep(allowed_s or 0.0)  # it cannot be cancelled
        return False

    def on_cancel(self, callback: Callable[[], object]) -> None:
        """Calls this, on another thread, when its caller cancels the call; at once if that has happened."""
        if self.ongoing is not None:
            self.ongoing.on_cancel(callback)

    def raise_if_cancelled(self) -> None:
        """Raises Cancelled, the way to end a cancelled call, if its caller has cancelled it."""
        if self.cancelled:
            raise Cancelled(service=self.service)

    def progress(self, value: Any) -> None:
        """Reports progress to the caller: the latest value counts. Never waits.

        Args:
            value: plain data, a struct or a handle, which ``run.progress()`` then returns.
        """
        ongoing = self.ongoing
        report = None if ongoing is None else ongoing.report
        if ongoing is not None and report is not None:
            report(ongoing, value)

    def event(self, text: str) -> None:
        """Adds an event to the call's trace, never a secret; does nothing if the call is not traced.

        The first hundred events of a call are kept.
        """
        events = self.events
        if events is not None and len(events) < _MOST_EVENTS:
            events.append((time.monotonic_ns(), text))

    @property
    def remaining_s(self) -> float | None:
        """Seconds until it expires, never below zero; None if it does not."""
        return None if self.expires_ns is None else max(0.0, (self.expires_ns - time.monotonic_ns()) / 1e9)

    def patience_s(self, wait_s: float) -> float:
        """How long it may wait for others, in seconds, and still answer its caller in time.

        Args:
            wait_s: how long it would wait without a deadline.
        """
        left_s = self.remaining_s
        return wait_s if left_s is None else min(wait_s, left_s - min(_ANSWER_S, left_s / 5))


running: ContextVar[CallContext | None] = ContextVar("trade_call", default=None)


def current_call() -> CallContext | None:
    """The call that the running code serves, or None outside of one (also in a plain call of the method)."""
    return running.get()


def served_call() -> CallContext:
    """The call that the running code serves, for the middleware's own functions, which only run as services."""
    call = running.get()
    assert call is not None  # noqa: S101
    return call


def patience_s(wait_s: float) -> float:
    """How long the running code may wait for others, in seconds; see `CallContext.patience_s`."""
    call = running.get()
    return wait_s if call is None else call.patience_s(wait_s)


def progress(value: Any) -> None:
    """Reports progress to the caller, inside a service; see `CallContext.progress`. Elsewhere it does nothing."""
    call = running.get()
    if call is not None:
        call.progress(value)
