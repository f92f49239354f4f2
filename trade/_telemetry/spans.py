"""Spans of the calls of a traced container: what was called, for whom, when, for how long, with what outcome."""

import itertools
import time
from collections import deque
from collections.abc import Callable, Collection, Sequence
from threading import Lock
from typing import TYPE_CHECKING, Any, Final, Literal

from msgspec import Struct, structs

from trade._context.call_context import CallContext
from trade._context.interceptor import Interceptor, ServedCall
from trade._context.outgoing import Request
from trade._telemetry.log_buffer import listen
from trade.protocol.keys import DOMAIN, Address, ServiceKey
from trade.protocol.messages import Token

if TYPE_CHECKING:
    from trade._resources.lock_table import LockTable

MOST: Final = 10_000
"""The number of spans that a container keeps: the newest."""
_LOCKING: Final = frozenset(("acquire", "release"))
"""The middleware's own functions whose calls are part of a program's work."""


class Span(Struct, frozen=True, kw_only=True):
    """One call, recorded by its caller's container or by its provider's. Without arguments and results."""

    call_id: int
    calls: tuple[int, ...]
    """The calls that led to it, nearest first."""
    service: str
    side: Literal["asked", "served"]
    container: str
    """The container that recorded it."""
    caller: str
    """Identity of the caller."""
    session: str
    began: float
    """``time.time()`` of that container's host."""
    waited_s: float = 0.0
    """Time in the queue of a serial provider, for a remote call; ``began`` excludes it."""
    took_s: float
    """From ``began`` to the end, hooks included."""
    outcome: str
    """``ok``, or the type of its error."""
    locks: tuple[str, ...] = ()
    """The locks it ran under in that container: purpose and owner."""
    events: tuple[tuple[float, str], ...] = ()
    """Events during the call, each with the seconds since it began."""
    remote: bool = False
    """Whether it was ``served`` for another container."""
    number: int = 0
    """Counted from 1 in the container that recorded it."""

    @property
    def ids(self) -> tuple[int, ...]:
        """Its own id and those of the calls that led to it."""
        return (self.call_id, *self.calls)


def traceable(key: ServiceKey) -> bool:
    """Whether calls of a service are recorded at all."""
    return key.domain != DOMAIN or key.name in _LOCKING


class Spans:
    """Owns the spans of one container."""

    def __init__(
        self,
        container: str,
        identity: str,
        session: str,
        locks: Callable[[Sequence[Token]], list[str]],
        on_span: Callable[[Span], None] | None = None,
    ) -> None:
        self._container = container
        self._identity = identity
        self._session = session
        self.locks = locks
        """Describes the locks of tokens."""
        self._on_span = on_span
        """Called with each span."""
        self.watch: Callable[[Span], None] | None = None
        """Also called with each span, while calls are compared with usual ones."""
        self._lock = Lock()
        self._spans: deque[Span] = deque(maxlen=MOST)
        self._count = 0

    def record_outgoing(self, call_id: int, service: str, request: Request, error: BaseException | None) -> None:
        """Record the end of a call to another container."""
        now_ns = time.monotonic_ns()
        took_s = (now_ns - request.deadline_ns) / 1e9 + request.deadline_s
        inherited = request.inherited
        outer, client = (None, None) if inherited is None else (inherited.outer, inherited.client)
        self._store(
            Span(
                call_id=call_id,
                calls=() if outer is None else (outer.id, *ancestors(outer)),
                service=service,
                side="asked",
                container=self._container,
                caller=self._identity,
                session=self._session if client is None else client.name,
                began=time.time() - took_s,
                took_s=took_s,
                outcome=_outcome(error),
            )
        )

    def record_incoming(
        self,
        context: CallContext,
        calls: tuple[int, ...],
        began: float,
        began_ns: int,
        locks: Sequence[str],
        error: BaseException | None,
    ) -> None:
        """Record the end of a call to this container."""
        ongoing = context.ongoing
        queued_ns = 0 if ongoing is None else ongoing.queued_ns
        self._store(
            Span(
                call_id=context.id,
                calls=calls,
                service=context.service,
                side="served",
                container=self._container,
                caller=context.caller,
                session=context.session,
                began=began,
                waited_s=(began_ns - queued_ns) / 1e9 if queued_ns else 0.0,
                took_s=(time.monotonic_ns() - began_ns) / 1e9,
                outcome=_outcome(error),
                locks=tuple(locks),
                events=tuple(((at_ns - began_ns) / 1e9, text) for at_ns, text in context.events or ()),
                remote=ongoing is not None and ongoing.call is not None,
            )
        )

    def _store(self, span: Span) -> None:
        with self._lock:
            self._count += 1
            structs.force_setattr(span, "number", self._count)
            self._spans.append(span)
        if self._on_span is not None:
            self._on_span(span)
        if self.watch is not None:
            self.watch(span)

    def kept(self, calls: Collection[int] | None = None, after: int = 0) -> list[Span]:
        """Spans with higher numbers, oldest first; of these calls and those that they led to, or of all."""
        with self._lock:
            old = max(0, after - self._count + len(self._spans))
            kept = list(itertools.islice(self._spans, old, None))
        return kept if calls is None else [span for span in kept if not frozenset(span.ids).isdisjoint(calls)]


class SpanRecorder(Interceptor):
    """Records a span of each call while the service is traced."""

    def __init__(self, spans: Spans) -> None:
        self._spans = spans

    def run(self, call: ServedCall, proceed: Callable[[], Any]) -> Any:
        """Call the service and record a span. Its errors pass through."""
        context = call.context
        structs.force_setattr(context, "events", [])
        calls = ancestors(context)  # the context forgets them at its end
        locks = self._spans.locks(context.tokens) if context.tokens else ()
        began, began_ns = time.time(), time.monotonic_ns()
        failed: BaseException | None = None
        try:
            return proceed()
        except BaseException as error:
            failed = error
            raise
        finally:
            self._spans.record_incoming(context, calls, began, began_ns, locks, failed)
            del failed  # it refers to this frame


def ancestors(context: CallContext) -> tuple[int, ...]:
    """The calls that led to a running one, nearest first."""
    return () if context.behalf is None else context.behalf.calls


def _outcome(error: BaseException | None) -> str:
    return "ok" if error is None else type(error).__name__


def new_spans(own: Address, session: str, table: "LockTable", on_span: Callable[[Span], None] | None) -> Spans:
    """The spans of a container; also starts the log buffer of its process."""
    listen()

    def purposes(tokens: Sequence[Token]) -> list[str]:
        held = (info.holder for info in table.infos() if info.token in tokens)
        return [f"{holder.purpose} ({holder.owner})" if holder.purpose else holder.owner for holder in held]

    return Spans(own.container, own.identity, session, purposes, on_span)
