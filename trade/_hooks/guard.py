"""Guards of a container: checks that may refuse calls of its services before these run, and never alter a call."""

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any, Final, NamedTuple, cast

from trade._calls.client import CallClient
from trade._calls.handle import Handle
from trade._context.call_context import CallContext
from trade._context.interceptor import ServedCall
from trade._hooks.callee import Callee, callee_of
from trade._hooks.hook import CallCopies, HookEvent, as_the_container
from trade._registry.constraints import Constraint, as_constraint, services_at
from trade._registry.registry import Record
from trade._services.decorator import require_check
from trade._services.local_service import LocalService
from trade._threads.thread_pool import ThreadPool
from trade.errors import CallRefused, ConfigurationError
from trade.protocol.keys import DOMAIN

LIMIT_S: Final = 1.0
"""How long a check may take by default."""
_LONGEST_S: Final = 3600.0
_MOST: Final = 32
"""The number of checks of one guard that may run at the same time, those that hang included."""

Check = Callable[[HookEvent], str | None]
"""Returns why the call is refused; None, or an empty text: it may run."""


def _name(check: Check) -> str:
    return getattr(check, "__name__", type(check).__name__).strip("_")


class _Answer:
    """The answer of one check, from another thread."""

    def __init__(self) -> None:
        self.arrived = threading.Event()
        self._reason: Any = None
        self._error: BaseException | None = None

    def give(self, check: Callable[[], Any]) -> None:
        try:
            self._reason = check()
        except BaseException as error:  # noqa: BLE001 - whatever it raises, the call is refused
            self._error = error
        self.arrived.set()

    def why(self) -> str:
        """Why the call is refused; empty: it may run."""
        if self._error is not None:
            return f"its check failed with {type(self._error).__name__}: {self._error}"
        if self._reason is None or isinstance(self._reason, str):
            return self._reason or ""
        return f"its check returned {self._reason!r}; a check returns a text that says why not, or None"


class Guard(AbstractContextManager["Guard"]):
    """One guard of this container; it ends with `remove`, at the end of a ``with`` block, or with the container."""

    def __init__(
        self,
        check: Check | Callee,
        target: Constraint | Handle | None,
        limit_s: float,
        end: "Callable[[Guard], None]",
    ) -> None:
        service = check if isinstance(check, Callee) else None
        self.name: Final = _name(cast("Check", check)) if service is None else service.text
        """The name of its check, as errors show it."""
        self.target: Final = target
        """What it guards; None: the service whose ``@service`` names it."""
        self.limit_s: Final = limit_s
        """How long a check may take, in seconds."""
        self.passed = 0
        """The number of calls that it has let through."""
        self.refused = 0
        """The number of calls that it has refused."""
        self._check: Final = cast("Check", check)
        self._service: Final = service
        """The service that decides, in place of a function."""
        self._end = end
        self._running = 0
        self._lock = threading.Lock()

    def means(self, record: Record) -> bool:
        """Whether it guards a service."""
        if isinstance(self.target, Handle):
            return self.target.key == record.key
        return self.target is not None and self.target.matches(record)

    def remove(self) -> None:
        """Ends it; a check under way still decides over its call. Idempotent."""
        self._end(self)

    def __exit__(self, *_: object) -> None:
        self.remove()

    def __repr__(self) -> str:
        return f"<Guard {self.name} of {self.target}, {self.passed} passed, {self.refused} refused>"

    def decide(self, called: HookEvent, context: CallContext, guards: "Guards") -> None:
        """Raises CallRefused unless its check lets the call through, within its time."""
        reason = self._reason(called, context, guards)
        if reason:
            self.refused += 1
            raise CallRefused(service=context.service, guard=self.name, reason=reason)
        self.passed += 1

    def _reason(self, called: HookEvent, context: CallContext, guards: "Guards") -> str:
        marker = f"guard {self.name} of {context.service}"
        if marker in context.chain:
            return "its check led to this call itself"
        with self._lock:
            if self._running >= _MOST:
                return f"{_MOST} of its checks have not ended"
            self._running += 1
        answer, left_s = _Answer(), self._left_s(context)
        chain = (*context.chain, context.service)

        def run() -> None:
            try:
                with as_the_container(context, marker, chain, time.monotonic_ns() + int(left_s * 1e9)):
                    answer.give(lambda: self._ask(called, context, left_s, guards.client))
            finally:
                with self._lock:
                    self._running -= 1

        guards.pool.begin(run, "trade-guard")
        context.on_cancel(answer.arrived.set)
        if not answer.arrived.wait(left_s):
            return f"its check did not answer within {left_s:.3g} s"
        context.raise_if_cancelled()
        return answer.why()

    def _left_s(self, context: CallContext) -> float:
        """A check never outlasts the call."""
        if context.expires_ns is None:
            return self.limit_s
        return max(0.0, min(self.limit_s, (context.expires_ns - time.monotonic_ns()) / 1e9))

    def _ask(self, called: HookEvent, context: CallContext, left_s: float, client: CallClient) -> Any:
        if self._service is None:
            return self._check(called)
        service = self._service.now(client)
        if service is None:
            return f"no service matches {self._service.constraint}, its check"
        asked = service.with_(deadline_s=left_s).start(called)
        context.on_cancel(asked.cancel)
        return asked.result(left_s)


class _GuardedService(NamedTuple):
    """A guard on one service."""

    guard: Guard
    handle: Handle
    guards: "Guards"

    def require(self, call: ServedCall) -> None:
        """Raises CallRefused unless the call may run."""
        self.guard.decide(self.guards.copies.event(call, self.handle), call.context, self.guards)


class Guards:
    """Owns the guards of one container: those of ``@service(guard=...)``, and those that programs add."""

    def __init__(self, client: CallClient, copies: CallCopies, recheck: Callable[[], None]) -> None:
        self.copies: Final = copies
        self.pool: Final = ThreadPool()
        self.client: Final = client
        self._recheck = recheck
        self._lock = threading.Lock()
        self._added: tuple[Guard, ...] = ()

    def guard(
        self, target: Handle | Constraint | str, check: Check | Handle | Constraint, *, limit_s: float = LIMIT_S
    ) -> Guard:
        """Lets a check refuse calls of services of this container, before they run.

        The check gets the call with copies of its arguments. It returns None to let the call run, or a text that says
        why not; the caller then gets a CallRefused. A check that raises, takes too long or returns anything else
        refuses the call, too. A stop is never guarded.

        The check of a service that needs physical resources runs once the call is admitted: a stop, or a lock that is
        taken meanwhile, ends the call.

        Args:
            target: a service of this container, or all that match a constraint or a text, later ones included.
            check: a function, which runs on a thread of its own, or a service in any container: its handle, or a
                constraint that only this service matches. The constraint follows a restart of the service.
            limit_s: how long the check may take, in seconds, at most an hour; never longer than the call's deadline.

        Returns:
            The guard: it lasts until its ``remove()``, the end of its ``with`` block, or the end of the container.

        Raises:
            ConfigurationError: the target is a stop or not of this container, or an argument has a wrong type.
        """
        named = "trade.guard"
        meant = target if isinstance(target, Handle) else as_constraint(target, named, services_at)
        if isinstance(meant, Handle):
            _require_guardable(meant, named)
        asked = callee_of(cast("object", check), named) if isinstance(check, Handle | Constraint) else check
        if not isinstance(asked, Callee):
            require_check(named, asked)
        if not isinstance(limit_s, int | float) or not 0 < limit_s <= _LONGEST_S:  # pyright: ignore[reportUnnecessaryIsInstance]
            raise ConfigurationError(where=named, problem=f"limit_s is 3600 s at most and above 0, not {limit_s!r}")
        added = Guard(asked, meant, limit_s, self._end)
        with self._lock:
            self._added = (*self._added, added)
        self._recheck()
        return added

    def guards(self) -> list[Guard]:
        """The guards of this container that programs added and that have not ended, oldest first."""
        return list(self._added)

    def apply(self, records: Sequence[Record], services: Mapping[str, LocalService]) -> None:
        """Give each service its guards: before it is offered, and after each change."""
        for record in records:
            service = services[record.name]
            if record.key.domain == DOMAIN or service.effect == "stop":
                continue
            found = [guard for guard in self._added if guard.means(record)]
            own = _own(service)
            if found or own or service.guards:
                handle = self.client.handle(record.key)
                service.guards = tuple(_GuardedService(guard, handle, self) for guard in (*own, *found))

    def _end(self, guard: Guard) -> None:
        with self._lock:
            self._added = tuple(one for one in self._added if one is not guard)
        self._recheck()


def _own(service: LocalService) -> list[Guard]:
    """The guard of its mark, which keeps its counts."""
    kept = [one.guard for one in service.guards if isinstance(one, _GuardedService) and one.guard.target is None]
    if service.check is None or kept:
        return kept
    return [Guard(service.check, None, LIMIT_S, lambda _: None)]


def _require_guardable(handle: Handle, named: str) -> None:
    record = handle.record
    if not record.local:
        problem = f"{handle.label} is a service of container {handle.container}, which alone can guard it"
        raise ConfigurationError(where=named, problem=problem)
    if record.info.effect == "stop" or record.key.domain == DOMAIN:
        raise ConfigurationError(where=named, problem=f"{handle.label} cannot be guarded: nothing may refuse it")
