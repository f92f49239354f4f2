"""TRADE: a service middleware for robots.

Any object's ``@service`` methods become callable from anywhere in the system; services are found by what they are. The
functions here use the process's default container, which starts itself on first use.
"""

import threading
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from typing import Any

from msgspec import Meta

from trade import errors
from trade import records as _records
from trade._calls.batch import Outcome
from trade._calls.handle import Bound, Handle
from trade._calls.run import Run
from trade._container.container import Container
from trade._container.hooking import Hook
from trade._container.notifying import POLL_S
from trade._container.reachability import Reachability
from trade._container.system import System
from trade._container.tracing import LogReader, Trace
from trade._context.call_context import CallContext, current_call, progress
from trade._context.sessions import Session
from trade._counters import Measure
from trade._estop.broadcast import EstopReport
from trade._estop.controller import LIMIT_S
from trade._hooks.hook import HookEvent, HookInfo
from trade._locks.api import LEASE_S, RESUME_WAIT_S
from trade._locks.lock import Lock, OnLost, OnRequest
from trade._notifications.notification import Notification, NotificationInfo
from trade._notifications.triggers import What
from trade._protocol.container_info import ContainerInfo
from trade._protocol.messages import HEALTHY, Estop, Scalar
from trade._protocol.samples import Sample
from trade._protocol.schema_types import publish as _publish
from trade._registry.constraints import Constraint, where
from trade._resources.grants import LockInfo
from trade._resources.resource import Permit, Resource, permit
from trade._services.decorator import service
from trade._services.secret import Secret
from trade._settings import Settings
from trade._stop_line import StopReport
from trade._streams.stream import If, Stream
from trade._telemetry.load import LoadInfo
from trade._telemetry.log_buffer import LogLine
from trade._telemetry.spans import Span

__all__ = [
    "Bound",
    "CallContext",
    "Constraint",
    "Container",
    "ContainerInfo",
    "Estop",
    "EstopReport",
    "Handle",
    "Hook",
    "HookEvent",
    "HookInfo",
    "LoadInfo",
    "Lock",
    "LockInfo",
    "LogLine",
    "LogReader",
    "Measure",
    "Meta",
    "Notification",
    "NotificationInfo",
    "Outcome",
    "Permit",
    "Reachability",
    "Resource",
    "Run",
    "Sample",
    "Secret",
    "Session",
    "Settings",
    "Span",
    "StopReport",
    "Stream",
    "System",
    "Trace",
    "acall",
    "acall_all",
    "acall_sequence",
    "add_group",
    "after",
    "after_service",
    "alter",
    "at",
    "before_service",
    "break_lock",
    "call",
    "call_all",
    "call_sequence",
    "cancel_notification",
    "changed",
    "close",
    "container",
    "containers",
    "current_call",
    "deregister",
    "detach_hook",
    "errors",
    "estop",
    "estop_clear",
    "estops",
    "every",
    "find",
    "hooks",
    "joined",
    "left",
    "lock",
    "locks",
    "logs",
    "migrate",
    "notifications",
    "once",
    "open_session",
    "permit",
    "progress",
    "register",
    "remove_group",
    "request_release",
    "restore_state",
    "resume",
    "save_state",
    "service",
    "services",
    "set_groups",
    "set_health",
    "set_tracing",
    "spans",
    "start",
    "stop",
    "stream",
    "system",
    "trace",
    "where",
]

_lock = threading.RLock()
_default: Container | None = None


def start(settings: Settings | None = None) -> Container:
    """Start the default container with settings of one's own.

    Raises:
        errors.ConfigurationError: it runs already; start it before the first other use of ``trade``.
    """
    global _default  # noqa: PLW0603 - the one default
    with _lock:
        if _default is not None:
            problem = (
                "the default container runs already; call trade.start before anything else, or trade.close() first"
            )
            raise errors.ConfigurationError(problem=problem)
        _default = Container(settings)
        return _default


def container() -> Container:
    """The default container, started if need be."""
    running = _default
    if running is not None:
        return running
    with _lock:
        return _default if _default is not None else start()


_running = container  # where an argument has its name


def close() -> None:
    """Leave the system: close the default container. The next use starts a new one. Idempotent."""
    global _default
    with _lock:
        running, _default = _default, None
    if running is not None:
        running.close()


system = System(container)
"""The switches of the default container."""


def register(
    provider: object,
    groups: str | Sequence[str] = (),
    *,
    implements: Sequence[type] = (),
    meta: Mapping[str, Scalar] | None = None,
) -> tuple[Handle, ...]:
    """Offer an object's services to the whole system; see `Container.register`."""
    return container().register(provider, groups, implements=implements, meta=meta)


def deregister(provider: object) -> None:
    """Withdraw an object's services from the whole system; see `Container.deregister`."""
    container().deregister(provider)


def set_groups(provider: object, groups: str | Sequence[str]) -> None:
    """Put a live provider into other groups; see `Container.set_groups`."""
    container().set_groups(provider, groups)


def add_group(provider: object, group: str) -> None:
    """Put a live provider into one more group; see `Container.add_group`."""
    container().add_group(provider, group)


def remove_group(provider: object, group: str) -> None:
    """Take a live provider out of a group; see `Container.remove_group`."""
    container().remove_group(provider, group)


def set_health(provider: object, health: str = HEALTHY) -> None:
    """Say what is wrong with a provider, or that nothing is any more; see `Container.set_health`."""
    container().set_health(provider, health)


def alter(provider: object, *, meta: Mapping[str, Scalar] | None = None) -> None:
    """Read a live provider again, as if registered anew; see `Container.alter`."""
    container().alter(provider, meta=meta)


def migrate(
    which: Handle | Constraint, *, to: str, args: Sequence[Any] | Mapping[str, Any] | None = None
) -> tuple[Handle, ...]:
    """Have a provider go on in another container, with its state; see `Container.migrate`."""
    return container().migrate(which, to=to, args=args)


def save_state(which: Handle | Constraint) -> Any:
    """What a provider remembers, as plain data; see `Container.save_state`."""
    return container().save_state(which)


def restore_state(which: Handle | Constraint, state: Any) -> None:
    """Give a provider what it remembered; see `Container.restore_state`."""
    container().restore_state(which, state)


def services(constraint: Constraint | None = None) -> list[Handle]:
    """Handles of all services that match; see `Container.services`."""
    return container().services(constraint)


def find(constraint: Constraint, *, wait_s: float = 2.0) -> Handle:
    """The only service that matches; see `Container.find`."""
    return container().find(constraint, wait_s=wait_s)


def call(constraint: Constraint, /, *args: Any, **kwargs: Any) -> Any:
    """Call the only service that matches; see `Container.call`."""
    return container().call(constraint, *args, **kwargs)


def call_all(which: Constraint | Iterable[Handle | Bound], /, *args: Any, **kwargs: Any) -> list[Outcome]:
    """Call several services at once; see `Container.call_all`."""
    return container().call_all(which, *args, **kwargs)


def call_sequence(calls: Iterable[Handle | Bound], /, *, go_on: bool = False) -> list[Outcome]:
    """Make calls one after the other; see `Container.call_sequence`."""
    return container().call_sequence(calls, go_on=go_on)


async def acall(constraint: Constraint, /, *args: Any, **kwargs: Any) -> Any:
    """`call` from asyncio."""
    return await container().acall(constraint, *args, **kwargs)


async def acall_all(which: Constraint | Iterable[Handle | Bound], /, *args: Any, **kwargs: Any) -> list[Outcome]:
    """`call_all` from asyncio."""
    return await container().acall_all(which, *args, **kwargs)


async def acall_sequence(calls: Iterable[Handle | Bound], /, *, go_on: bool = False) -> list[Outcome]:
    """`call_sequence` from asyncio."""
    return await container().acall_sequence(calls, go_on=go_on)


def containers() -> list[ContainerInfo]:
    """The containers of the system, this one included."""
    return container().containers()


def joined(
    constraint: Constraint, call: What, *, existing: bool = False, if_: What | None = None, host: str = ""
) -> Notification:
    """Call with the handle of every service that comes and matches; see `Container.joined`."""
    return container().joined(constraint, call, existing=existing, if_=if_, host=host)


def left(constraint: Constraint, call: What, *, if_: What | None = None, host: str = "") -> Notification:
    """Call with the handle of every service that goes and matched; see `Container.left`."""
    return container().left(constraint, call, if_=if_, host=host)


def changed(constraint: Constraint, call: What, *, if_: What | None = None, host: str = "") -> Notification:
    """Call with the handle of every service that matches and is altered; see `Container.changed`."""
    return container().changed(constraint, call, if_=if_, host=host)


def once(
    call: What, *, if_: What | None = None, when: What | None = None, poll_s: float = POLL_S, host: str = ""
) -> Notification:
    """Make that call once, without waiting for it; see `Container.once`."""
    return container().once(call, if_=if_, when=when, poll_s=poll_s, host=host)


def after(
    s: float,
    call: What,
    *,
    if_: What | None = None,
    when: What | None = None,
    poll_s: float = POLL_S,
    host: str = "",
) -> Notification:
    """Make that call after so many seconds; see `Container.after`."""
    return container().after(s, call, if_=if_, when=when, poll_s=poll_s, host=host)


def at(
    moment: datetime,
    call: What,
    *,
    if_: What | None = None,
    when: What | None = None,
    poll_s: float = POLL_S,
    host: str = "",
) -> Notification:
    """Make that call at a moment; see `Container.at`."""
    return container().at(moment, call, if_=if_, when=when, poll_s=poll_s, host=host)


def every(
    s: float,
    call: What,
    *,
    if_: What | None = None,
    when: What | None = None,
    edge: bool = False,
    poll_s: float = POLL_S,
    host: str = "",
) -> Notification:
    """Make that call every so many seconds; see `Container.every`."""
    return container().every(s, call, if_=if_, when=when, edge=edge, poll_s=poll_s, host=host)


def notifications() -> list[NotificationInfo]:
    """Every notification that stands anywhere in the system."""
    return container().notifications()


def cancel_notification(notification: str) -> None:
    """End a notification, wherever it lives; see `Container.cancel_notification`."""
    container().cancel_notification(notification)


def before_service(target: Handle | Constraint, call: Handle) -> Hook:
    """Have a service called before each call of another one; see `Container.before_service`."""
    return container().before_service(target, call)


def after_service(target: Handle | Constraint, call: Handle) -> Hook:
    """Have a service called after each call of another one; see `Container.after_service`."""
    return container().after_service(target, call)


def hooks() -> list[HookInfo]:
    """Every hook in the system, once for each container it is attached in."""
    return container().hooks()


def detach_hook(hook: str) -> None:
    """End a hook by its id, wherever it is attached; see `Container.detach_hook`."""
    container().detach_hook(hook)


def set_tracing(on: bool, *, container: str = "*") -> list[str]:
    """Have containers note every call they make and serve, or no more; see `Container.set_tracing`."""
    return _running().set_tracing(on, container=container)


def spans(*, container: str = "*") -> list[Span]:
    """What the containers noted of calls while they were traced; see `Container.spans`."""
    return _running().spans(container=container)


def trace(call_id: int) -> Trace:
    """The whole tree that a call belongs to; see `Container.trace`."""
    return container().trace(call_id)


def logs(*, container: str = "*") -> list[LogLine]:
    """What the processes of the system logged lately; see `Container.logs`."""
    return _running().logs(container=container)


def stream(
    target: Handle | Constraint,
    *,
    hz: float = 10.0,
    on_change: bool = False,
    if_: If | None = None,
    call: What | None = None,
    keep: int = 16,
) -> Stream:
    """Have a service sampled as long as one listens; see `Container.stream`."""
    return container().stream(target, hz=hz, on_change=on_change, if_=if_, call=call, keep=keep)


def lock(
    which: Constraint | Iterable[Handle],
    *,
    purpose: str = "",
    wait_s: float = 10.0,
    lease_s: float = LEASE_S,
    priority: int = 0,
    delegates: Sequence[str] = (),
    partial: bool = False,
    on_lost: OnLost | None = None,
    on_request: OnRequest | None = None,
) -> Lock:
    """Services for oneself alone: ``with trade.lock(where(group="rosie.head"), purpose="look"):``.

    See `Container.lock`.
    """
    return container().lock(
        which,
        purpose=purpose,
        wait_s=wait_s,
        lease_s=lease_s,
        priority=priority,
        delegates=delegates,
        partial=partial,
        on_lost=on_lost,
        on_request=on_request,
    )


def locks() -> list[LockInfo]:
    """Every lock in the system; see `Container.locks`."""
    return container().locks()


def request_release(which: Constraint | Iterable[Handle], reason: str) -> list[str]:
    """Ask the owners of locks to give them back; see `Container.request_release`."""
    return container().request_release(which, reason)


def break_lock(which: Constraint | Iterable[Handle], reason: str) -> list[LockInfo]:
    """Take locks away from their owners; see `Container.break_lock`."""
    return container().break_lock(which, reason)


def resume(which: Constraint | Iterable[Handle], *, wait_s: float = RESUME_WAIT_S) -> list[str]:
    """Let services move again after a stop by somebody else; see `Container.resume`."""
    return container().resume(which, wait_s=wait_s)


def stop(group: str, reason: str = "", *, limit_s: float = LIMIT_S) -> StopReport:
    """Stop all that moves in a group; see `Container.stop`. Not safety-rated."""
    return container().stop(group, reason, limit_s=limit_s)


def estop(reason: str = "", *, limit_s: float = LIMIT_S, estop_id: str = "") -> EstopReport:
    """Stop everything in the whole system until it is cleared; see `Container.estop`. Not safety-rated."""
    return container().estop(reason, limit_s=limit_s, estop_id=estop_id)


def open_session(client: str) -> Session:
    """A presence for one client of a program that acts for many; see `Container.open_session`."""
    return container().open_session(client)


def estops() -> list[Estop]:
    """The e-stops that are open; see `Container.estops`."""
    return container().estops()


def estop_clear(ids: Sequence[str], *, limit_s: float = LIMIT_S) -> EstopReport:
    """Clear e-stops by their ids; see `Container.estop_clear`."""
    return container().estop_clear(ids, limit_s=limit_s)


for _name in __all__:  # `help(trade.lock)` says all that there is to say
    if f"see `Container.{_name}`" in (_said := getattr(globals()[_name], "__doc__", None) or "").replace("See", "see"):
        globals()[_name].__doc__ = getattr(Container, _name).__doc__

_publish(
    __name__, ContainerInfo, Estop, EstopReport, Handle, HookInfo, LoadInfo, LockInfo, LogLine, NotificationInfo, Span
)
_publish(_records.__name__, *(getattr(_records, _name) for _name in _records.__all__))
