"""The container: one participant of a system. Each feature has its own module and is listed here."""

import asyncio
import functools
import secrets
import threading
from collections.abc import Callable, Coroutine, Iterable
from typing import Any, Concatenate, Final, Literal, ParamSpec, TypeVar, cast

from trade._calls.client import CallClient
from trade._calls.find_types import Acall, Afind, Find, FindRobot
from trade._calls.handle import Handle
from trade._calls.sessions import Sessions
from trade._container.assembly import Components
from trade._container.builtin_services import OwnServices
from trade._container.registration import Registration
from trade._container.system import System
from trade._context.call_context import running
from trade._counters import Measure
from trade._discovery.dialer import Dialer
from trade._estop.controller import EstopController
from trade._estop.services import EstopServices
from trade._hooks.api import HookApi
from trade._hooks.guard import Guards
from trade._locks.api import LockApi
from trade._migration.api import MigrationApi
from trade._migration.factory import ProviderFactory
from trade._notifications.api import NotificationApi
from trade._registry.registry import Registry
from trade._settings import Settings
from trade._streams.api import StreamApi
from trade._threads import fork_guard
from trade._threads.event import Event
from trade._tracing.api import TraceApi
from trade.protocol.keys import Address, ServiceKey
from trade.stop_line import StopApi
from trade.transport.base import Transport

_STOPPING_S: Final = 2.0

_P = ParamSpec("_P")
_R = TypeVar("_R")
_Part = TypeVar("_Part")


def delegated(
    part: Callable[[Components], _Part], method: Callable[Concatenate[_Part, _P], _R]
) -> "Callable[Concatenate[Container, _P], _R]":
    """A method of the container that delegates to a component, with its signature and docstring."""

    @functools.wraps(method)
    def call(self: "Container", /, *args: _P.args, **kwargs: _P.kwargs) -> _R:
        self.client.check_open()
        return method(part(self._parts), *args, **kwargs)

    return call


def adelegated(
    part: Callable[[Components], _Part], method: Callable[Concatenate[_Part, _P], Coroutine[Any, Any, _R]]
) -> "Callable[Concatenate[Container, _P], Coroutine[Any, Any, _R]]":
    """The same of a coroutine function."""

    @functools.wraps(method)
    async def call(self: "Container", /, *args: _P.args, **kwargs: _P.kwargs) -> _R:
        self.client.check_open()
        return await method(part(self._parts), *args, **kwargs)

    return call


def in_thread(
    method: "Callable[Concatenate[Container, _P], _R]",
) -> "Callable[Concatenate[Container, _P], Coroutine[Any, Any, _R]]":
    """A method of the container as a coroutine function: it waits on a thread, not on the event loop.

    Its session and its locks apply on that thread, too. Cancelling the coroutine does not end what the thread does.
    """

    @functools.wraps(method)
    async def call(self: "Container", /, *args: _P.args, **kwargs: _P.kwargs) -> _R:
        return await asyncio.to_thread(method, self, *args, **kwargs)

    return call


class Container:
    """A participant of a system; most programs use the default one through the functions of ``trade``.

    It joins on construction. A context manager; ``close()`` leaves the system and is idempotent.

    Args:
        settings: by default those of the environment.
        transport: carries everything; by default zenoh.
        on_terminate: called in place of ``close()`` when a client has ended the container: a program that exists for
            its container then ends itself, and closes the container.

    Raises:
        ConfigurationError: a setting is wrong, the endpoint is taken, or this process was forked from one that has a
            container.
    """

    def __init__(
        self,
        settings: Settings | None = None,
        *,
        transport: Transport | None = None,
        on_terminate: Callable[[], None] | None = None,
    ) -> None:
        fork_guard.refuse_after_fork()
        fork_guard.note_start()
        self.settings: Final = settings or Settings.read()
        """Its settings."""
        self.address: Final = Address(self.settings.identity, self.settings.container, secrets.token_hex(6))
        self.session: Final = str(self.address)
        self._closing = threading.RLock()
        self._parts = Components(self, self.address, self.settings, transport, on_terminate or self.close)
        self.client: Final = self._parts.client
        """Finds and calls services for it."""
        self.access: Final = self._parts.access
        """The access policy, as it applies here."""
        self.lock_api: Final = self._parts.lock_api
        """Its locks on services, its own and others'."""
        self.events: Final = self._parts.events
        """The events of its states."""
        self.federation: Final = self._parts.federation
        """Its services as another system sees them."""
        self.system: Final = System(lambda: self._parts)
        """Its controls: its links, its discovery, and others."""
        self._parts.appear(OwnServices(self._parts, self.system), EstopServices(self._parts.estop))
        fork_guard.live.add(self)

    # --- offering

    register = delegated(lambda parts: parts.registration, Registration.register)
    register_functions = delegated(lambda parts: parts.registration, Registration.register_functions)
    deregister = delegated(lambda parts: parts.registration, Registration.deregister)
    set_groups = delegated(lambda parts: parts.registration, Registration.set_groups)
    add_group = delegated(lambda parts: parts.registration, Registration.add_group)
    remove_group = delegated(lambda parts: parts.registration, Registration.remove_group)
    set_health = delegated(lambda parts: parts.registration, Registration.set_health)
    alter = delegated(lambda parts: parts.registration, Registration.alter)
    migrate = delegated(lambda parts: parts.migration_api, MigrationApi.migrate)
    save_state = delegated(lambda parts: parts.migration_api, MigrationApi.save_state)
    restore_state = delegated(lambda parts: parts.migration_api, MigrationApi.restore_state)

    # --- finding and calling

    services = delegated(lambda parts: parts.client, CallClient.services)
    find: Find = cast("Find", delegated(lambda parts: parts.client, CallClient.find))
    robot: FindRobot = cast("FindRobot", delegated(lambda parts: parts.client, cast("Any", CallClient.robot)))
    await_services = delegated(lambda parts: parts.client, CallClient.await_services)
    reachability = delegated(lambda parts: parts.client, CallClient.reachability)
    beyond = delegated(lambda parts: parts.client, CallClient.beyond)
    call = delegated(lambda parts: parts.client, CallClient.call)
    call_all = delegated(lambda parts: parts.client, CallClient.call_all)
    call_sequence = delegated(lambda parts: parts.client, CallClient.call_sequence)
    everywhere = delegated(lambda parts: parts.client, CallClient.everywhere)
    afind: Afind = cast("Afind", in_thread(cast("Any", find)))
    acall: Acall = cast("Acall", adelegated(lambda parts: parts.client, CallClient.acall))
    acall_all = adelegated(lambda parts: parts.client, CallClient.acall_all)
    acall_sequence = adelegated(lambda parts: parts.client, CallClient.acall_sequence)

    # --- locks and stops

    lock = delegated(lambda parts: parts.lock_api, LockApi.lock)
    locks = delegated(lambda parts: parts.lock_api, LockApi.locks)
    request_release = delegated(lambda parts: parts.lock_api, LockApi.request_release)
    break_lock = delegated(lambda parts: parts.lock_api, LockApi.break_lock)
    resume = delegated(lambda parts: parts.lock_api, LockApi.resume)
    stop = delegated(lambda parts: parts.stop_api, StopApi.stop)
    estop = delegated(lambda parts: parts.estop, EstopController.estop)
    estops = delegated(lambda parts: parts.estop, EstopController.estops)
    astop = in_thread(stop)
    aestop = in_thread(estop)
    aresume = in_thread(resume)
    alocks = in_thread(locks)
    estop_clear = delegated(lambda parts: parts.estop, EstopController.estop_clear)

    # --- notifications, hooks, streams, traces

    joined = delegated(lambda parts: parts.notification_api, NotificationApi.joined)
    left = delegated(lambda parts: parts.notification_api, NotificationApi.left)
    changed = delegated(lambda parts: parts.notification_api, NotificationApi.changed)
    occurred = delegated(lambda parts: parts.notification_api, NotificationApi.occurred)
    once = delegated(lambda parts: parts.notification_api, NotificationApi.once)
    after = delegated(lambda parts: parts.notification_api, NotificationApi.after)
    at = delegated(lambda parts: parts.notification_api, NotificationApi.at)
    every = delegated(lambda parts: parts.notification_api, NotificationApi.every)
    notifications = delegated(lambda parts: parts.notification_api, NotificationApi.notifications)
    cancel_notification = delegated(lambda parts: parts.notification_api, NotificationApi.cancel_notification)
    before_service = delegated(lambda parts: parts.hook_api, HookApi.before_service)
    after_service = delegated(lambda parts: parts.hook_api, HookApi.after_service)
    guard = delegated(lambda parts: parts.guards, Guards.guard)
    guards = delegated(lambda parts: parts.guards, Guards.guards)
    hooks = delegated(lambda parts: parts.hook_api, HookApi.hooks)
    detach_hook = delegated(lambda parts: parts.hook_api, HookApi.detach_hook)
    stream = delegated(lambda parts: parts.stream_api, StreamApi.stream)
    astream = in_thread(stream)
    set_tracing = delegated(lambda parts: parts.trace_api, TraceApi.set_tracing)
    spans = delegated(lambda parts: parts.trace_api, TraceApi.spans)
    trace = delegated(lambda parts: parts.trace_api, TraceApi.trace)
    logs = delegated(lambda parts: parts.trace_api, TraceApi.logs)

    # --- its own set-up

    load_policy = delegated(lambda parts: parts, Components.load_policy)

    def note_change(self, change: str, subject: str = "") -> None:
        """Adds a change of configuration to the audit record, if one is kept (`Settings.audit`).

        Args:
            change: the change, in a few words.
            subject: the file or the device.
        """
        self._parts.audit.changed(change, subject, running.get())

    def note_request(
        self,
        request: str,
        service: str = "",
        *,
        kind: Literal["call", "stop", "refused"] = "call",
        client: str = "",
        outcome: str = "ok",
        error: str = "",
        took_ns: int = 0,
    ) -> None:
        """Adds a request to a program that acts for others, such as an agent's tool, to the audit record, if kept.

        Args:
            request: the request, in a few words.
            service: the service, without arguments, which may be secret.
            kind: the kind of the row.
            client: the identity that the program acts for; empty: this container.
            outcome: ``ok``, or the type of the error.
            error: the message of the error.
            took_ns: the duration in nanoseconds.
        """
        own = self.address
        self._parts.audit.note(
            kind,
            request,
            about=service,
            who=client or own.identity,
            session=str(own),
            outcome=outcome,
            why=error,
            took_ns=took_ns,
        )

    def measured_by(self, read: Callable[[], Iterable[Measure]]) -> None:
        """Adds metrics to this container's own (`Settings.metrics`).

        Args:
            read: called at each reading; returns numbers that are known already, without waiting.
        """
        self._parts.measured.append(read)

    @property
    def metrics_port(self) -> int:
        """The port of its metrics; 0: none."""
        return self._parts.metrics_port

    # --- looking up

    def addresses(self) -> list[Address]:
        """The addresses of the system's containers, this one included."""
        return [state.address for state in self._parts.registry.containers()]

    containers = delegated(lambda parts: parts, Components.containers)

    def handle(self, key: ServiceKey) -> Handle:
        """A handle of a service whose key is known."""
        return self.client.handle(key)

    @property
    def reach(self) -> Dialer:
        """Its links; raises ConfigurationError on a transport without links."""
        return self._parts.reach

    # --- its life

    open_session = delegated(lambda parts: parts.sessions, Sessions.open_session)
    make_default = delegated(lambda parts: parts.factory, ProviderFactory.host)

    @property
    def registry(self) -> Registry:
        """The registry of the services in its system."""
        return self._parts.registry

    @property
    def session_end(self) -> Event[str]:
        """Emitted with the name of each session that ends."""
        return self._parts.session_end

    @property
    def name(self) -> str:
        """The container's name."""
        return self.address.container

    @property
    def dropped_messages(self) -> int:
        """The number of messages that were malformed, or of another protocol version."""
        return self._parts.dropped_messages

    @property
    def catching_up(self) -> bool:
        """Whether it is requesting registry entries that it may have missed, or has yet to announce its own."""
        return self._parts.watch.busy or not self._parts.announcer.introduced

    def healthy(self) -> bool:
        """Whether it can take a call now; code that feeds hardware watchdogs checks this."""
        return not self.closed and self._parts.dispatcher.draining

    @property
    def closed(self) -> bool:
        """Whether it was closed."""
        return self.client.closed

    def close(self) -> None:
        """Leaves the system: services, handles and notifications end; nothing remains. Idempotent.

        It waits up to 2 s for stops under way; other calls end with ContainerLost.
        """
        if fork_guard.forked():
            return
        with self._closing:  # a second thread waits until it is done
            if self.closed:
                return
            self.lock_api.lease_client.close()  # releases its locks while it can still send
            self._parts.caller.finish_stops(_STOPPING_S)
            self._parts.close()

    def abandon(self) -> None:
        """Refuses everything in a forked child, and touches nothing: it all belongs to the parent."""
        self._parts.abandon()

    def __enter__(self) -> "Container":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<Container {self.address} of {self.settings.system}>"
