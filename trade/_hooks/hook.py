"""Hooks before and after a service, in the container where it runs: attached from anywhere, unable to alter calls."""

import logging
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Final, Literal

import msgspec
from msgspec import Struct

from trade._calls.client import CallClient
from trade._calls.handle import Handle
from trade._context.call_context import CallContext, running
from trade._context.interceptor import Interceptor, ServedCall, ServedService
from trade._context.outgoing import holding
from trade._context.sessions import speaking
from trade._hooks.callee import Callee
from trade._registry.constraints import Constraint
from trade._registry.registry import Change, Record
from trade._services.local_service import LocalService
from trade._settings import LONGEST_HOOK_S
from trade._telemetry.spans import SpanRecorder, Spans, traceable
from trade._threads.event import Event
from trade._threads.scheduler import Scheduler
from trade.errors import AccessDenied, ConfigurationError, DeadlineExceeded
from trade.protocol.codec import Codec
from trade.protocol.keys import DOMAIN, ServiceKey

_logger = logging.getLogger("trade")

_TOGETHER: Final = 2.5
"""How long all hooks of one side of a call may take together, in limits of the one that has most time."""
_TRIES: Final = 3
"""A hook is suspended after this many failures in a row."""
_MOST: Final = 1000
"""The largest number of hooks in a container."""

Side = Literal["before", "after"]


class HookEvent(Struct, frozen=True, kw_only=True):
    """The call that a hook receives: the service, its arguments and caller; afterwards also the outcome."""

    service: Handle
    args: dict[str, Any]
    """By name, as plain data; ``***`` replaces secret values."""
    caller: str
    """Identity of the caller."""
    session: str
    call_id: int
    chain: tuple[str, ...]
    """Services whose calls led to it, outermost first."""
    ended: bool = False
    """Whether the service has run: True for hooks that are called after it."""
    result: Any = None
    """As plain data; None also if it failed."""
    error: str = ""
    """Type and message of its error."""
    took_s: float = 0.0

    @property
    def ok(self) -> bool:
        """Whether the call ended with a result."""
        return self.ended and not self.error


class HookInfo(Struct, frozen=True, kw_only=True):
    """The public description of one hook in one container."""

    id: str
    side: Side
    target: str
    """The services it applies to, as text."""
    call: str
    """The service that it calls: ``rosie.watch.saw``, or ``the service with name='saw'``."""
    owner: str
    """The session that attached it."""
    container: str
    """The container of the services."""
    services: tuple[str, ...]
    """The services there that it is attached to."""
    fired: int
    skipped: int
    """How often it was left out: it led to the call itself, no service matched, or no time was left."""
    failures: int
    suspended: bool
    last_error: str


Denied = Callable[[str, Record], "AccessDenied | None"]
"""Why an identity may not instrument a service; None if it may."""


class AttachedHook:
    """One hook in this container."""

    def __init__(
        self,
        name: str,
        side: Side,
        target: Handle | Constraint,
        call: Callee,
        limit_s: float,
        owner: str,
        identity: str,
        suspended: Callable[["AttachedHook"], None],
    ) -> None:
        self.name: Final = name
        self.side: Final[Side] = side
        self.target: Final = target
        self.call: Final = call
        self.limit_s: Final = limit_s
        self.owner: Final = owner
        self.identity: Final = identity
        self._tell_suspended = suspended
        self.suspended = False
        self.called: ServiceKey | None = None if call.handle is None else call.handle.key
        """The service that it called last."""
        self.services: dict[ServiceKey, str] = {}
        self.fired = self.skipped = self.failures = 0
        self._in_a_row = 0
        self.last_error = ""

    def means(self, record: Record) -> bool:
        """Whether the hook applies to a service."""
        if isinstance(self.target, Handle):
            return self.target.key == record.key
        return self.target.matches(record)

    def tell(self, client: CallClient, called: HookEvent, chain: Sequence[str], left_s: float) -> None:
        """Call the hook within this time and its own. Whatever its outcome, the watched call continues."""
        allowed_s = min(self.limit_s, left_s)
        if allowed_s <= 0:
            self.skipped += 1
            return
        try:
            call = self.call.now(client)
            if call is None:
                self.skipped, self.last_error = self.skipped + 1, f"no service matches {self.call.constraint}"
                return
            self.called = call.key
            if call.label in chain:
                self.skipped += 1
                return
            client.require_call(self.identity, call)
            call.with_(deadline_s=allowed_s).start(called).result(allowed_s)
            self.fired += 1
            self._in_a_row = 0
        except TimeoutError:
            self._failed(f"cut off: it took longer than the {allowed_s:.3g} s that it had")
        except BaseException as error:  # noqa: BLE001 - an error of a hook never reaches the caller
            self._failed(f"{type(error).__name__}: {error}")

    def joined(self, record: Record) -> None:
        """A service has joined: a suspended hook continues if it is the one to call."""
        if self.suspended and self.call.follows(record):
            self.suspended, self._in_a_row = False, 0

    def _failed(self, text: str) -> None:
        self.failures += 1
        self._in_a_row += 1
        self.last_error = text
        if self._in_a_row >= _TRIES and not self.suspended:
            self.suspended = True
            _logger.warning("hook %s is suspended after %d failures: %s", self.call.text, self._in_a_row, text)
            self._tell_suspended(self)


def require_limit(limit_s: float | None, where: str) -> None:
    """Raises ConfigurationError if a hook cannot have that limit."""
    if limit_s is not None and not 0 < limit_s <= LONGEST_HOOK_S:
        problem = f"limit_s must be above 0 and at most {LONGEST_HOOK_S:g} seconds, not {limit_s:g}"
        raise ConfigurationError(where=where, problem=problem)


class CallCopies:
    """Makes the copies of calls that hooks and guards get: they see the values, and cannot change them."""

    def __init__(self, codec: Codec) -> None:
        self._encode = codec.encode
        self._decode = codec.decoder(Any)

    def event(self, call: ServedCall, handle: Handle) -> HookEvent:
        """The call of a service as it is before it runs."""
        context, named = call.context, call.service.signature.named(call.args, call.kwargs)
        return HookEvent(
            service=handle,
            args={name: self.plain(value) for name, value in named.items()},
            caller=context.caller,
            session=context.session,
            call_id=context.id,
            chain=context.chain,
        )

    def plain(self, value: Any) -> Any:
        """A copy that can be sent."""
        try:
            return self._decode(self._encode(value))
        except Exception:  # noqa: BLE001 - only a local call without strict can carry such a value
            return repr(value)


class HookInterceptor(Interceptor):
    """The hooks of one service in this container."""

    def __init__(
        self,
        client: CallClient,
        copies: CallCopies,
        scheduler: Scheduler,
        limit_s: float,
        handle: Handle,
        hooks: Sequence[AttachedHook],
    ) -> None:
        self._client = client
        self._copies = copies
        self._scheduler = scheduler
        self._limit_s = limit_s
        self._handle = handle
        self._before = [hook for hook in hooks if hook.side == "before"]
        self._after = [hook for hook in hooks if hook.side == "after"]

    def run(self, call: ServedCall, proceed: Callable[[], Any]) -> Any:
        """Call the service with its hooks around it. Its own errors pass through."""
        began_ns = time.monotonic_ns()
        service, _, _, context = call
        called = self._copies.event(call, self._handle)
        if self._before and service.effect != "stop":
            self._call(self._before, called, context)
            if service.too_late(context.expires_ns):
                raise DeadlineExceeded(service=service.label, deadline_s=(time.monotonic_ns() - began_ns) / 1e9)
        result, error = None, ""
        try:
            result = proceed()
        except BaseException as raised:
            error = _error_text(service, raised)
            raise
        finally:
            if self._after:
                took_s = (time.monotonic_ns() - began_ns) / 1e9
                ended = msgspec.structs.replace(
                    called, ended=True, result=self._copies.plain(result), error=error, took_s=took_s
                )
                if service.effect == "stop":  # nothing holds up the answer to a stop
                    self._scheduler.begin(lambda: self._call(self._after, ended, context), time.monotonic_ns())
                else:
                    self._call(self._after, ended, context)
        return result

    def _call(self, hooks: Sequence[AttachedHook], called: HookEvent, context: CallContext) -> None:
        chain = (*context.chain, context.service)
        longest_s = max(self._limit_s, *(hook.limit_s for hook in hooks))
        until_ns = time.monotonic_ns() + int(_TOGETHER * longest_s * 1e9)
        with as_the_container(context, context.service, context.chain, context.expires_ns):
            for hook in hooks:
                if not hook.suspended:
                    hook.tell(self._client, called, chain, (until_ns - time.monotonic_ns()) / 1e9)


def _error_text(service: ServedService, error: BaseException) -> str:
    """The error as text, without its message if that may show a secret."""
    kind = type(error).__name__
    return kind if service.signature.has_secrets else f"{kind}: {error}"


@contextmanager
def as_the_container(context: CallContext, what: str, chain: tuple[str, ...], expires_ns: int | None):
    """Runs calls of hooks and guards within the session of the call that they see, but without its locks.

    Args:
        context: that call.
        what: what makes them, as the chain of the calls shows it.
        chain: what led there, outermost first.
        expires_ns: their deadline.
    """
    bare = CallContext(context.id, what, context.caller, context.session, expires_ns, chain)
    tokens = running.set(bare), holding.set(()), speaking.set(None)
    try:
        yield
    finally:
        running.reset(tokens[0])
        holding.reset(tokens[1])
        speaking.reset(tokens[2])


class Hooks:
    """Owns the hooks of one container."""

    def __init__(
        self,
        client: CallClient,
        copies: CallCopies,
        scheduler: Scheduler,
        limit_s: float,
        services: Callable[[ServiceKey], LocalService | None],
        records: Callable[[], list[Record]],
        denied: Denied,
    ) -> None:
        self._client = client
        self._copies = copies
        self._scheduler = scheduler
        self._limit_s = limit_s
        self._services = services
        self._records = records
        self._denied = denied
        self._lock = threading.RLock()
        self._attached: dict[tuple[str, str], AttachedHook] = {}
        """By session and name."""
        self._spans: Spans | None = None
        """The spans of this container while it is traced."""
        self.suspended: Final = Event[AttachedHook]()
        """Emitted with each hook that is suspended."""

    def attach(
        self,
        name: str,
        side: Side,
        target: Handle | Constraint,
        call: Callee,
        owner: str,
        identity: str,
        limit_s: float | None = None,
    ) -> list[str]:
        """Attach a hook; repeating it changes nothing. Returns the labels of the services it is attached to.

        Args:
            limit_s: how long it may take, in seconds; None: as the container's settings say.

        Raises:
            AccessDenied: its owner may instrument none of the services here.
            ConfigurationError: the hook is to run before a stop service, its limit is out of range, or there are too
                many hooks.
        """
        require_limit(limit_s, self._client.name)
        own_s = self._limit_s if limit_s is None else limit_s
        hook = AttachedHook(name, side, target, call, own_s, owner, identity, self.suspended.emit)
        with self._lock:
            if (owner, name) not in self._attached and len(self._attached) >= _MOST:
                raise ConfigurationError(where=self._client.name, problem=f"{_MOST} hooks are attached here already")
            meant = [record for record in self._records() if _hookable(record) and hook.means(record)]
            stops = [record for record in meant if record.info.effect == "stop" and side == "before"]
            if stops and isinstance(target, Handle):
                problem = "nothing comes before a stop; attach it after the service, or to others"
                raise ConfigurationError(where=stops[0].label, problem=problem)
            denials = [self._denied(identity, record) for record in meant]
            if meant and all(denials):
                raise next(denial for denial in denials if denial is not None)
            known = self._attached.setdefault((owner, name), hook)
            self._refresh()
            return sorted(known.services.values())

    def detach(self, owner: str, name: str) -> bool:
        """Detach a hook; returns whether it existed."""
        with self._lock:
            gone = self._attached.pop((owner, name), None)
            if gone is not None:
                self._refresh()
            return gone is not None

    def named(self, name: str) -> list[AttachedHook]:
        """The hooks of a name."""
        return [hook for hook in list(self._attached.values()) if hook.name == name]

    def session_ended(self, session: str) -> None:
        """Detach the hooks of a session that ended."""
        with self._lock:
            gone = [key for key in self._attached if key[0] == session]
            for key in gone:
                del self._attached[key]
            if gone:
                self._refresh()

    def changed(self, change: Change) -> None:
        """Called by the registry."""
        for hook in list(self._attached.values()):
            for record in change.joined:
                hook.joined(record)
        if self._in_use and any(record.local for record in (*change.joined, *change.replaced, *change.left)):
            self.recheck_access()

    def recheck_access(self) -> None:
        """Check again which services exist, and who may instrument them."""
        with self._lock:
            if self._in_use:
                self._refresh()

    def trace(self, spans: Spans | None) -> None:
        """Record a span of every service call from now on; None: stop recording."""
        with self._lock:
            self._spans = spans
            self._refresh()

    @property
    def _in_use(self) -> bool:
        return bool(self._attached) or self._spans is not None

    def _refresh(self) -> None:
        hooks = list(self._attached.values())
        for hook in hooks:
            hook.services = {}
        for record in self._records():
            service = self._services(record.key)
            if service is None:
                continue
            mine = [hook for hook in hooks if _hookable(record) and self._concerns(hook, record)]
            for hook in mine:
                hook.services[record.key] = record.label
            service.interceptors = (*_lasting(service), *self._interceptors(record, mine))

    def _interceptors(self, record: Record, hooks: Sequence[AttachedHook]) -> Iterator[Interceptor]:
        if self._spans is not None and traceable(record.key):
            yield SpanRecorder(self._spans)
        if hooks:
            handle = self._client.handle(record.key)
            yield HookInterceptor(self._client, self._copies, self._scheduler, self._limit_s, handle, hooks)

    def _concerns(self, hook: AttachedHook, record: Record) -> bool:
        return hook.means(record) and self._denied(hook.identity, record) is None

    def infos(self) -> list[HookInfo]:
        """The hooks attached here, oldest first."""
        return [
            HookInfo(
                id=hook.name,
                side=hook.side,
                target=hook.target.label if isinstance(hook.target, Handle) else str(hook.target),
                call=hook.call.text,
                owner=hook.owner,
                container=self._client.name,
                services=tuple(sorted(hook.services.values())),
                fired=hook.fired,
                skipped=hook.skipped,
                failures=hook.failures,
                suspended=hook.suspended,
                last_error=hook.last_error,
            )
            for hook in list(self._attached.values())
        ]


def _lasting(service: LocalService) -> list[Interceptor]:
    """The interceptors that a service has from the start: audit."""
    return [one for one in service.interceptors if not isinstance(one, SpanRecorder | HookInterceptor)]


def _hookable(record: Record) -> bool:
    """Whether a service can have hooks: the middleware's own cannot, as locks, stops and hooks depend on them."""
    return record.local and record.key.domain != DOMAIN
