"""The container: one participant of a system. Each feature has its own module and is listed here."""

import asyncio
import functools
import itertools
import secrets
import threading
from collections.abc import Callable, Coroutine, Iterable
from pathlib import Path
from typing import Any, Concatenate, Final, Literal, ParamSpec, TypeVar, cast

from trade._calls.handle import Handle
from trade._calls.run import Run
from trade._calls.target import container_closed
from trade._calls.target_cache import Target
from trade._container.assembly import Components
from trade._container.builtin_services import OwnServices
from trade._container.federating import Federating
from trade._container.hooking import Hooking
from trade._container.lookup import Acall, Afind, Find, FindRobot, Lookup
from trade._container.migrating import Migrating
from trade._container.notifying import Notifying
from trade._container.registering import Registering
from trade._container.streaming import Streaming
from trade._container.system import System
from trade._container.tracing import Tracing
from trade._context.call_context import running
from trade._context.outgoing import new_request
from trade._context.sessions import Session, client_name
from trade._counters import Measure
from trade._discovery.dialer import Dialer
from trade._estop.controller import EstopController
from trade._estop.services import EstopServices
from trade._hooks.guard import Guards
from trade._locks.api import LockApi
from trade._protocol.container_info import ContainerInfo
from trade._protocol.keys import Address, ServiceKey, alive_key, as_chunk
from trade._registry.registry import Record, Registry
from trade._security.authorizer import Authorizer, verb_of
from trade._settings import Settings
from trade._table import Table
from trade._threads import fork_guard
from trade._threads.event import Event
from trade._transport.base import ChannelClosed, Transport
from trade.errors import ConfigurationError

_STOPPING_S: Final = 2.0
_COLUMNS: Final = {
    "CONTAINER": "name",
    "IDENTITY": "identity",
    "HOST": "host",
    "PID": "pid",
    "SERVICES": "services",
    "EPOCH": "epoch",
}


_P = ParamSpec("_P")
_R = TypeVar("_R")


def delegated(part: str, method: Callable[Concatenate[Any, _P], _R]) -> "Callable[Concatenate[Container, _P], _R]":
    """A method of the container that delegates to a component, with its signature and docstring."""

    @functools.wraps(method)
    def call(self: "Container", /, *args: _P.args, **kwargs: _P.kwargs) -> _R:
        self._check_open()
        return method(getattr(self, part), *args, **kwargs)

    return call


def adelegated(
    part: str, method: Callable[Concatenate[Any, _P], Coroutine[Any, Any, _R]]
) -> "Callable[Concatenate[Container, _P], Coroutine[Any, Any, _R]]":
    """The same of a coroutine function."""

    @functools.wraps(method)
    async def call(self: "Container", /, *args: _P.args, **kwargs: _P.kwargs) -> _R:
        self._check_open()
        return await method(getattr(self, part), *args, **kwargs)

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

    Raises:
        ConfigurationError: a setting is wrong, the endpoint is taken, or this process was forked from one that has a
            container.
    """

    def __init__(self, settings: Settings | None = None, *, transport: Transport | None = None) -> None:
        fork_guard.refuse_after_fork()
        fork_guard.note_start()
        self.settings = settings or Settings.read()
        """Its settings."""
        self.address = Address(self.settings.identity, self.settings.container, secrets.token_hex(6))
        self.session = str(self.address)
        self.system: Final = System(lambda: self)
        """Its controls: its links, its discovery, and others."""
        self.access = Authorizer(self.settings.policy, certified=self.settings.tls is not None)
        """The access policy, as it applies here."""
        self._clients = itertools.count(1)
        self._closing = threading.RLock()
        self._closed = False
        self._parts = Components(self, self.settings, transport)
        self._known = self._parts.targets.known
        self._build_features(self._parts)
        self.locking: Final = self._parts.lock_api
        """Its locks on services, its own and others'."""
        self.estopping: Final = self._parts.estop
        """Its e-stops."""
        self.guarding: Final = self._parts.guards
        """Its guards."""
        self.borrowed: Final = self._parts.remote_locks
        """The locks in other systems behind its grants."""
        self.withdrawn: Final = self._parts.withdrawn
        """The providers that were deregistered remotely and can be offered again."""
        self.making: Final = self._parts.factory
        """The providers that it created on request."""
        self.arriving: Final = self._parts.migration_target
        """The providers that migrate to it, and restored ones."""
        self.meter: Final = self._parts.load_meter
        """Its load."""
        self.events: Final = self._parts.events
        """The events of its states."""
        self.terminating: Final = self._parts.shutdown
        """Its shutdown on request."""
        self._parts.appear(OwnServices(self._parts, self), EstopServices(self._parts.estop))
        fork_guard.live.add(self)

    def _build_features(self, parts: Components) -> None:
        access, registry = self.access, parts.registry
        lookup = Lookup(self, registry, parts.dialer, access, self.settings.system, self._check_open)
        notifying = Notifying(lookup, parts.notifier, registry)
        self._lookup = lookup
        self._registering = Registering(lookup, parts.providers, parts.withdrawn, parts.deadman)
        self._migrating = Migrating(lookup, registry)
        self._notifying = notifying
        self._hooking = Hooking(lookup, notifying, access)
        self._streaming = Streaming(lookup, parts.subscriptions, parts.scheduler)
        self._tracing = Tracing(lookup)
        self.federating = Federating(self.address, registry, parts.providers, parts.locks, parts.event_loop)
        """Its services as another system sees them."""

    # --- offering

    register = delegated("_registering", Registering.register)
    register_functions = delegated("_registering", Registering.register_functions)
    deregister = delegated("_registering", Registering.deregister)
    set_groups = delegated("_registering", Registering.set_groups)
    add_group = delegated("_registering", Registering.add_group)
    remove_group = delegated("_registering", Registering.remove_group)
    set_health = delegated("_registering", Registering.set_health)
    alter = delegated("_registering", Registering.alter)
    migrate = delegated("_migrating", Migrating.migrate)
    save_state = delegated("_migrating", Migrating.save_state)
    restore_state = delegated("_migrating", Migrating.restore_state)

    # --- finding and calling

    services = delegated("_lookup", Lookup.services)
    find: Find = cast("Find", delegated("_lookup", Lookup.find))
    robot: FindRobot = cast("FindRobot", delegated("_lookup", cast("Any", Lookup.robot)))
    await_services = delegated("_lookup", Lookup.await_services)
    reachability = delegated("_lookup", Lookup.reachability)
    beyond = delegated("_lookup", Lookup.beyond)
    call = delegated("_lookup", Lookup.call)
    call_all = delegated("_lookup", Lookup.call_all)
    call_sequence = delegated("_lookup", Lookup.call_sequence)
    everywhere = delegated("_lookup", Lookup.everywhere)
    afind: Afind = cast("Afind", in_thread(cast("Any", find)))
    acall: Acall = cast("Acall", adelegated("_lookup", Lookup.acall))
    acall_all = adelegated("_lookup", Lookup.acall_all)
    acall_sequence = adelegated("_lookup", Lookup.acall_sequence)

    # --- locks and stops

    lock = delegated("locking", LockApi.lock)
    locks = delegated("locking", LockApi.locks)
    request_release = delegated("locking", LockApi.request_release)
    break_lock = delegated("locking", LockApi.break_lock)
    resume = delegated("locking", LockApi.resume)
    stop = delegated("_parts", Components.stop)
    estop = delegated("estopping", EstopController.estop)
    estops = delegated("estopping", EstopController.estops)
    astop = in_thread(stop)
    aestop = in_thread(estop)
    aresume = in_thread(resume)
    alocks = in_thread(locks)
    estop_clear = delegated("estopping", EstopController.estop_clear)

    # --- notifications, hooks, streams, traces

    joined = delegated("_notifying", Notifying.joined)
    left = delegated("_notifying", Notifying.left)
    changed = delegated("_notifying", Notifying.changed)
    occurred = delegated("_notifying", Notifying.occurred)
    once = delegated("_notifying", Notifying.once)
    after = delegated("_notifying", Notifying.after)
    at = delegated("_notifying", Notifying.at)
    every = delegated("_notifying", Notifying.every)
    notifications = delegated("_notifying", Notifying.notifications)
    cancel_notification = delegated("_notifying", Notifying.cancel_notification)
    before_service = delegated("_hooking", Hooking.before_service)
    after_service = delegated("_hooking", Hooking.after_service)
    guard = delegated("guarding", Guards.guard)
    guards = delegated("guarding", Guards.guards)
    hooks = delegated("_hooking", Hooking.hooks)
    detach_hook = delegated("_hooking", Hooking.detach_hook)
    stream = delegated("_streaming", Streaming.stream)
    astream = in_thread(stream)
    set_tracing = delegated("_tracing", Tracing.set_tracing)
    spans = delegated("_tracing", Tracing.spans)
    trace = delegated("_tracing", Tracing.trace)
    logs = delegated("_tracing", Tracing.logs)

    # --- its own set-up

    def load_policy(self, path: Path | str) -> None:
        """Loads another access policy, or the same file again; calls under way continue.

        A container that was started with a policy (`Settings.policy`) reads it again when its files change; so it does
        with a policy that is loaded here.

        Services that the policy no longer allows leave the registry, and locks that it no longer allows are lost.

        Raises:
            ConfigurationError: the policy is wrong; the message says where. The earlier policy stays in force.
        """
        self._check_open()
        self.access.load(Path(path))
        self._parts.audit.changed("policy loaded", str(path), running.get())
        self._parts.recheck_access()

    def note_change(self, what: str, about: str = "") -> None:
        """Adds a change of configuration to the audit record, if one is kept (`Settings.audit`).

        Args:
            what: the change, in a few words.
            about: the file or the device.
        """
        self._parts.audit.changed(what, about, running.get())

    def note_asked(
        self,
        what: str,
        about: str = "",
        *,
        kind: Literal["call", "stop", "refused"] = "call",
        who: str = "",
        outcome: str = "ok",
        why: str = "",
        took_ns: int = 0,
    ) -> None:
        """Adds a request to a program that acts for others, such as an agent's tool, to the audit record, if kept.

        Args:
            what: the request, in a few words.
            about: the service, without arguments, which may be secret.
            kind: the kind of the row.
            who: the identity that the program acts for; empty: this container.
            outcome: ``ok``, or the type of the error.
            why: the message of the error.
            took_ns: the duration in nanoseconds.
        """
        own = self.address
        self._parts.audit.note(
            kind,
            what,
            about=about,
            who=who or own.identity,
            session=str(own),
            outcome=outcome,
            why=why,
            took_ns=took_ns,
        )

    def measured_by(self, tell: Callable[[], Iterable[Measure]]) -> None:
        """Adds metrics to this container's own (`Settings.metrics`).

        Args:
            tell: called at each reading; returns numbers that are known already, without waiting.
        """
        self._parts.measured.append(tell)

    @property
    def metrics_port(self) -> int:
        """The port of its metrics; 0: none."""
        return self._parts.metrics_port

    # --- looking up

    def addresses(self) -> list[Address]:
        """The addresses of the system's containers, this one included."""
        return [state.address for state in self._parts.registry.containers()]

    def containers(self) -> Table[ContainerInfo]:
        """The containers of the system, this one included."""
        self._check_open()
        infos = Table[ContainerInfo]((), _COLUMNS)
        for state in self._parts.registry.containers():
            records = [record for entry in list(state.providers.values()) for record in entry.records]
            first = records[0] if records else None
            infos.append(
                ContainerInfo(
                    name=state.address.container,
                    identity=state.address.identity,
                    epoch=state.address.epoch,
                    host=first.host if first else "",
                    pid=first.pid if first else 0,
                    providers=len(state.providers),
                    services=len(records),
                    protocol=state.protocol,
                )
            )
        return infos

    @property
    def reach(self) -> Dialer:
        """Its links; raises ConfigurationError on a transport without links."""
        self._check_open()
        if self._parts.dialer is None:
            raise ConfigurationError(problem="this container's transport cannot change its links while it runs")
        return self._parts.dialer

    def handle(self, key: ServiceKey) -> Handle:
        """A handle of a service whose key is known."""
        return Handle(self, key, self._parts.registry.get(key))

    def has(self, key: ServiceKey) -> bool:
        """Whether the registry has the service now."""
        return self._parts.registry.get(key) is not None

    def record(self, handle: Handle) -> Record:
        """The registry entry of a service, or the last known one; raises ServiceGone if it has none."""
        record = self._parts.registry.get(handle.key) or handle.last_record
        if record is None:
            raise self._parts.targets.gone(handle)
        return record

    # --- calling

    def invoke(self, handle: Handle, args: tuple[Any, ...], kwargs: dict[str, Any], deadline_s: float | None) -> Any:
        """Calls a service and waits, as ``handle(...)`` does."""
        outer = running.get()
        if outer is not None and outer.ongoing is not None:
            return self._begin(handle, args, kwargs, deadline_s, here=True).result()
        target = self._known.get(handle.key)
        if target is not None:
            return target.call(args, kwargs, deadline_s)
        request = new_request(deadline_s)
        return self._look_up(handle).invoke(args, kwargs, request)

    def begin(self, handle: Handle, args: tuple[Any, ...], kwargs: dict[str, Any], deadline_s: float | None) -> Run:
        """Calls a service without waiting, as ``handle.start(...)`` does."""
        return self._begin(handle, args, kwargs, deadline_s, here=False)

    def _begin(
        self, handle: Handle, args: tuple[Any, ...], kwargs: dict[str, Any], deadline_s: float | None, *, here: bool
    ) -> Run:
        """Calls a service without waiting; a call inside another one ends with that."""
        request, run, outer = new_request(deadline_s), Run(handle), running.get()
        target = self._known.get(handle.key) or self._look_up(handle)
        alone = outer is None or outer.cancelled or target.is_stop  # a cancelled call may still read and stop
        ongoing = None if outer is None or alone else outer.ongoing
        forget = _nothing if ongoing is None else run.end_with(ongoing)
        try:
            target.begin(args, kwargs, request, run, here=here)
        except BaseException:
            forget()
            raise
        return run

    def _look_up(self, handle: Handle) -> Target:
        self._check_open()
        return self._parts.targets.look_up(handle)

    # --- its life

    def open_session(self, client: str, *, system: str = "") -> Session:
        """Opens a session for one client, such as a page or a connection, of a program that acts for many (S03).

        Inside ``with container.open_session("page"):`` calls and locks are the client's: when it is closed, the
        client's motion stops and its locks are lost, but those of no other client.

        Args:
            client: a name for it; others see ``identity/container/epoch/client.number``.
            system: the client's own system, if it is another one; others see ``system/client via identity``.

        Raises:
            ConfigurationError: the container is closed.
        """
        self._check_open()
        whose = f"{as_chunk(system)[:20]}:" if system else ""
        name = f"{self.address}/{whose}{client_name(client)}.{next(self._clients)}"
        try:
            presence = self._parts.transport.appear(alive_key(name))
        except ChannelClosed:  # closed by another thread meanwhile
            raise container_closed(self.address) from None
        return Session(self.address, name, presence, self._parts.session_ended)

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

    def asked_for(self, handle: Handle) -> tuple[str, tuple[str, ...]]:
        """The right over its group that callers of a service need, and the roles that have it by the policy here."""
        key, policy = handle.key, self.access.policy
        verb = verb_of(key.domain, key.name, handle.record.info.effect)
        return verb, policy.roles_with(verb, key.domain) if policy is not None and verb else ()

    def require_call(self, who: str, handle: Handle) -> None:
        """Raises AccessDenied if a client for whom this container acts may not call that service."""
        key, record = handle.key, handle.record
        self.access.require_call(who, key.domain, key.name, record.info.effect, record.label)

    @property
    def dropped_messages(self) -> int:
        """The number of messages that were malformed, or of another protocol version."""
        return self._parts.dropped_messages

    @property
    def catching_up(self) -> bool:
        """Whether it is requesting registry entries that it may have missed."""
        return self._parts.watch.busy

    def healthy(self) -> bool:
        """Whether it can take a call now; code that feeds hardware watchdogs checks this."""
        return not self._closed and self._parts.dispatcher.draining

    @property
    def closed(self) -> bool:
        """Whether it was closed."""
        return self._closed

    def _check_open(self) -> None:
        fork_guard.refuse_after_fork()
        if self._closed:
            raise container_closed(self.address)

    def close(self) -> None:
        """Leaves the system: services, handles and notifications end; nothing remains. Idempotent.

        It waits up to 2 s for stops under way; other calls end with ContainerLost.
        """
        if fork_guard.forked():
            return
        with self._closing:  # a second thread waits until it is done
            if self._closed:
                return
            self.locking.lease_client.close()  # releases its locks while it can still send
            self._parts.caller.finish_stops(_STOPPING_S)
            self._closed = True
            self._parts.close()

    def abandon(self) -> None:
        """Refuses everything in a forked child, and touches nothing: it all belongs to the parent."""
        self._closed = True
        self._parts.abandon()

    def __enter__(self) -> "Container":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<Container {self.address} of {self.settings.system}>"


def _nothing() -> None:
    pass
