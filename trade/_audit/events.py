"""Audit events: reports the calls, locks, stops, refusals and configuration changes of a container to its record.

Without a record, it costs a call nothing. With one, a call puts one event into a queue; `writer` does the rest.
"""

import time
from collections.abc import Callable
from typing import Any, Final, Literal, NamedTuple, Protocol

from msgspec import Struct

from trade._context.call_context import CallContext
from trade._context.interceptor import Interceptor, ServedCall, ServedService
from trade._counters import CallCounters
from trade.errors import (
    AccessDenied,
    Busy,
    DeadlineExceeded,
    IncompleteGroup,
    InUse,
    InvalidArgument,
    LimitExceeded,
    LockedByOther,
    LockLost,
    NotInstantiable,
    NotLocked,
    SessionEnded,
    Stopped,
    TradeError,
)
from trade.protocol.keys import DOMAIN, Address

Kind = Literal["call", "read", "stop", "lock", "configure", "refused", "audit"]

_REFUSALS: Final = (
    AccessDenied,
    Busy,
    DeadlineExceeded,
    IncompleteGroup,
    InUse,
    InvalidArgument,
    LimitExceeded,
    LockedByOther,
    LockLost,
    NotInstantiable,
    NotLocked,
    SessionEnded,
    Stopped,
)
"""Errors that say that a call was refused, and why."""


class Event(Struct, frozen=True, gc=False):
    """One audited event."""

    at_ns: int
    """``time.time_ns()``"""
    monotonic_ns: int
    """``time.monotonic_ns()`` of the same moment."""
    kind: Kind
    what: str
    """The service, as errors name it, or a word."""
    about: Any
    """Further details: a text, a handle, names; the writer converts them to text."""
    who: str
    """Identity of the caller; empty: the event had no caller."""
    session: str
    """Of the caller. The writer names the client of another system that it may belong to, instead of the caller."""
    call_id: int
    """0: the event was not a call."""
    outer_id: int
    """The outermost call that led to it, the same in all containers; 0: the event was not a call."""
    outcome: str
    """``ok``, or the type of the error."""
    why: str
    """The message of our own errors; empty for other errors, and where an argument is secret."""
    took_ns: int


Tell = Callable[[Event], None]
"""Takes an event; returns at once, whatever happens to it."""


class Record(Protocol):
    """The state of a record's writer."""

    written: int
    lost: int

    @property
    def waiting(self) -> int: ...


class Audit:
    """Reports the events of a container; without a receiver, it does nothing.

    Args:
        tell: called with each event.
        own: the container.
        reads: also report services that only read.
        calls: counters of calls and refusals, if any.
        record: the writer of the events, for queries of its state.
    """

    def __init__(
        self,
        tell: Tell | None = None,
        own: Address | None = None,
        *,
        reads: bool = False,
        calls: CallCounters | None = None,
        record: Record | None = None,
    ) -> None:
        self._tell = tell
        self.calls = calls
        self.record = record
        self._own = own
        self._reads = reads

    def note(
        self,
        kind: Kind,
        what: str,
        *,
        about: Any = "",
        who: str = "",
        session: str = "",
        call_id: int = 0,
        outer_id: int = 0,
        outcome: str = "ok",
        why: str = "",
        took_ns: int = 0,
    ) -> None:
        """Report an event that is not a service call."""
        if self._tell is not None:
            at_ns, now_ns = time.time_ns(), time.monotonic_ns()
            self._tell(Event(at_ns, now_ns, kind, what, about, who, session, call_id, outer_id, outcome, why, took_ns))

    def refused(
        self,
        what: str,
        error: TradeError | str,
        *,
        who: str,
        session: str = "",
        call_id: int = 0,
        outer_id: int = 0,
    ) -> None:
        """Report that a caller was refused, with the error or the reason."""
        outcome = "Malformed" if isinstance(error, str) else type(error).__name__
        if self.calls is not None:
            self.calls.refuse(outcome)
        if self._tell is not None:
            self.note(
                "refused",
                what,
                who=who,
                session=session,
                call_id=call_id,
                outer_id=outer_id,
                outcome=outcome,
                why=str(error),
            )

    def changed(self, what: str, about: str, call: CallContext | None) -> None:
        """Report a change of configuration, made in a call or by this container itself."""
        if self._tell is None:
            return
        if call is not None:
            self.note(
                "configure",
                what,
                about=about,
                who=call.caller,
                session=call.session,
                call_id=call.id,
                outer_id=call.outer_id,
            )
        elif self._own is not None:
            self.note("configure", what, about=about, who=self._own.identity, session=str(self._own))

    def watch(self, domain: str, service: ServedService) -> None:
        """Report the calls of a service that is about to be offered."""
        if self._tell is None and self.calls is None:
            return
        rule = _rule(domain, service.info.name, service.effect, reads=self._reads)
        if rule is not None:
            service.interceptors = (Audited(self._tell, rule, self.calls, service.label), *service.interceptors)


class _Rule(NamedTuple):
    kind: Kind
    always: bool
    """Whether to report successful calls, too."""
    about: bool
    """Whether to report the first argument, too: only for the middleware's own functions, whose arguments are known."""


_LOCKS: Final = frozenset(("break_lock", "request_release"))
_STOPS: Final = frozenset(("estop", "estop_clear", "resume", "stop_group"))
_REPORTED_BY_TABLE: Final = frozenset(("acquire",))
"""The lock table reports these itself, in more detail; only their refusals are reported here."""
_SILENT: Final = frozenset(
    ("renew", "release", "release_requested", "notification_failed", "hook_suspended", "listen", "unlisten")
)
"""Routine messages between containers."""


def _rule(domain: str, name: str, effect: str, *, reads: bool) -> _Rule | None:
    """How to report the calls of a service; None: not at all."""
    if domain != DOMAIN:
        if effect == "read":
            return _Rule("read", reads, about=False)
        return _Rule("stop" if effect == "stop" else "call", always=True, about=False)
    if name in _SILENT or (effect == "read" and not reads):
        return None
    if effect == "read":
        return _Rule("read", always=True, about=False)
    kind: Kind = "lock" if name in _LOCKS or name in _REPORTED_BY_TABLE else "stop" if name in _STOPS else "configure"
    return _Rule(kind, name not in _REPORTED_BY_TABLE, about=True)


class Audited(Interceptor):
    """Counts the calls of a service, and reports each when it has ended."""

    __slots__ = ("_calls", "_rule", "_tell", "_timed")

    def __init__(self, tell: Tell | None, rule: _Rule, calls: CallCounters | None, label: str) -> None:
        self._tell = tell
        self._rule = rule
        self._calls = calls
        self._timed = None if calls is None else calls.of(label)

    def run(self, call: ServedCall, proceed: Callable[[], Any]) -> Any:
        """Call the service and report that. Its errors pass through."""
        began_ns, outer_id = time.monotonic_ns(), call.context.outer_id  # a call that has ended has no outer call
        try:
            result = proceed()
        except BaseException as error:
            if self._timed is not None:
                self._timed.add(time.monotonic_ns() - began_ns, failed=True)
            self._failed(call, error, began_ns, outer_id)
            raise
        if self._timed is not None:
            self._timed.add(time.monotonic_ns() - began_ns, failed=False)
        if self._rule.always:
            self._report(call, self._rule.kind, "ok", "", began_ns, outer_id)
        return result

    def rejected(self, call: ServedCall, error: BaseException) -> None:
        """Report a call that never began."""
        self._failed(call, error, 0, call.context.outer_id)

    def _failed(self, call: ServedCall, error: BaseException, began_ns: int, outer_id: int) -> None:
        refused = isinstance(error, _REFUSALS)
        if refused and self._calls is not None:
            self._calls.refuse(type(error).__name__)
        if refused or self._rule.always:
            kind: Kind = "refused" if refused else self._rule.kind
            shown = isinstance(error, TradeError) and not call.service.signature.has_secrets
            self._report(call, kind, type(error).__name__, str(error) if shown else "", began_ns, outer_id)

    def _report(self, call: ServedCall, kind: Kind, outcome: str, why: str, began_ns: int, outer_id: int) -> None:
        if self._tell is None:
            return
        about: Any = ""
        if self._rule.about and (call.args or call.kwargs):
            about = call.args[0] if call.args else next(iter(call.kwargs.values()))
        now_ns, context = time.monotonic_ns(), call.context
        who, session = context.caller, context.session
        took_ns = now_ns - began_ns if began_ns else 0
        at_ns, ids = time.time_ns(), (context.id, outer_id)
        self._tell(Event(at_ns, now_ns, kind, call.service.label, about, who, session, *ids, outcome, why, took_ns))
