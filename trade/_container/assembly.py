"""The components of a container: built in order, each from earlier ones, and closed in reverse order."""

import contextlib
import logging
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Final, Protocol

from trade._audit.events import open_audit
from trade._calls.caller import Caller
from trade._calls.handle import CallHost, Handle, handle_codec
from trade._calls.local_path import MARK, LocalPath
from trade._calls.target_cache import Targets
from trade._container.connect import join
from trade._container.policy_reload import begin_watching
from trade._container.shutdown import Shutdown
from trade._context.outgoing import handed_down
from trade._counters import Measure
from trade._discovery.announcer import Announcer
from trade._discovery.dialer import Dialer
from trade._discovery.listener import RegistryListener
from trade._estop.controller import LIMIT_S, EstopController, check_limit, is_stop
from trade._hooks import hook
from trade._hooks.guard import Guards
from trade._hooks.hook import CallCopies, Hooks
from trade._locks import api
from trade._locks.api import LockApi
from trade._locks.inherited import InheritedLock
from trade._locks.remote_locks import RemoteLocks
from trade._migration import factory
from trade._migration.delivered_code import CodeStore
from trade._migration.factory import ProviderFactory
from trade._migration.quiesce import Quiescer
from trade._migration.source import MigrationSource
from trade._migration.target import MigrationTarget
from trade._notifications import notification
from trade._notifications.events import EventLog
from trade._notifications.notifier import Notifier
from trade._notifications.states import States
from trade._protocol.keys import DOMAIN, ESTOP_PROVIDER, PROVIDER, Address, ServiceKey
from trade._protocol.messages import Token
from trade._registry.constraints import where
from trade._registry.registry import Change, Record, Registry
from trade._resources.lock_table import LockTable
from trade._resources.resource import Holder
from trade._services.dispatcher import Dispatcher
from trade._services.event_loop import AsyncLoop
from trade._services.local_server import LocalServer
from trade._services.providers import Providers
from trade._services.withdrawn import Withdrawn
from trade._settings import Settings
from trade._stop_line import GroupStop, RelayedEstop, StopLines, StopLineService, StopReport, session_for, together
from trade._streams import source as _streams
from trade._streams.source import Streams
from trade._streams.subscriptions import Subscriptions
from trade._telemetry.load import LoadMeter, resident_bytes
from trade._telemetry.otlp import open_export
from trade._telemetry.prometheus import open_metrics
from trade._telemetry.spans import Spans, new_spans
from trade._threads.event import Event
from trade._threads.scheduler import Scheduler
from trade._transport.base import Transport
from trade._transport.credentials import keep_secret, user_secret
from trade._transport.host_socket import host_sockets, listen_on_host
from trade._transport.local_greeting import Passport
from trade._transport.zenoh import ZenohTransport
from trade.errors import AccessDenied, TradeError

_logger = logging.getLogger("trade")


class Host(
    hook.HookHost,
    api.LockHost,
    factory.FactoryHost,
    notification.NotificationHost,
    _streams.StreamHost,
    CallHost,
    Protocol,
):
    """The container, as its components see it."""

    def close(self) -> None: ...


class Components:
    """The components of one container, and which of them owns which data."""

    def __init__(self, home: Host, settings: Settings, transport: Transport | None) -> None:
        self._home = home
        self._settings = settings
        self._access = home.access
        self._address = home.address
        self._session = str(home.address)
        self.session_end: Final = Event[str]()
        """Emitted with the name of each session that ends."""
        self.measured: Final[list[Callable[[], Iterable[Measure]]]] = []
        """Further metrics, for example of drivers."""
        with contextlib.ExitStack() as leaving:  # started components close again if a later one fails
            self._build_transport(leaving, transport)
            self._build_calls(leaving)
            self._build_locks(leaving)
            self._build_services(leaving)
            self._build_notifications_and_hooks(leaving)
            self._build_telemetry(leaving)
            self._build_streams(leaving)
            self._build_estop(leaving)
            self._build_migration(leaving)
            self._build_dispatch(leaving)
            self._build_stop_line(leaving)
            self._build_measures(leaving)
            self._build_states()
            self._leaving = leaving.pop_all()

    def _build_transport(self, leaving: contextlib.ExitStack, transport: Transport | None) -> None:
        self.audit = open_audit(self._settings, self._address, leaving)
        self._given = transport is not None
        """Whether the transport was given: then it carries everything."""
        self.events = EventLog(self._home.name)
        self._certificate = None if self._given else self._settings.certificate()
        self.transport = transport or join(
            self._settings,
            self._certificate,
            leaving,
            lambda until: self.events.note("certificate_ends", self._address.identity, until),
        )
        leaving.callback(self.transport.close)
        self.dialer: Dialer | None = None
        """Its links; None on a transport without links."""
        own_pair = not self._given and self._settings.tls is None and self._settings.credentials is None
        self._secret = user_secret()[1] if own_pair else ""
        """The secret of this user on this host, if the container's links use it."""
        self._links = self.transport.links if isinstance(self.transport, ZenohTransport) else None
        if isinstance(self.transport, ZenohTransport):
            self.dialer = Dialer(self.transport.links, self._settings.check_may_dial, self._settings.connect)
            leaving.callback(self.dialer.close)

    def _build_calls(self, leaving: contextlib.ExitStack) -> None:
        home, address = self._home, self._address
        self.codec = handle_codec(lambda handle: handle.key, home.handle)
        self.registry = Registry(address, self._access.may_offer, self._access.may_have_stops)
        self.local_path = self._local_path()
        self.caller = Caller(self.transport, address, self.local_path)
        leaving.callback(self.caller.close)
        self.scheduler = Scheduler("trade-clock")
        leaving.callback(self.scheduler.close)
        notified = Scheduler("trade-notifications", self.transport.clock)
        leaving.callback(notified.close)
        self.notifier = Notifier(home, notified, address.epoch, lambda record: Handle(home, record.key, record))
        leaving.callback(self.notifier.close)

    def _local_path(self) -> LocalPath | None:
        """The local path to others; None if it is switched off, or the transport was given."""
        settings = self._settings
        if not settings.local_path or self._given:
            return None
        password = "" if settings.tls is not None else "\n".join(settings.credentials or user_secret())
        return LocalPath(settings.system, Passport(self._address, settings.certificate, password))

    def _build_locks(self, leaving: contextlib.ExitStack) -> None:
        address = self._address
        self.inherited = InheritedLock(self._settings.lock, address) if self._settings.lock else None
        if self.inherited is not None:
            handed_down[address] = self.inherited
            leaving.callback(handed_down.pop, address)
        self.event_loop = AsyncLoop()
        leaving.callback(self.event_loop.close)
        self.lock_api = LockApi(self._home, self.transport.clock)
        self.locks = LockTable(address.epoch, self._home.name, self.transport.clock, self.audit)
        leaving.callback(self.locks.close)
        self.remote_locks = RemoteLocks(self.locks, address.epoch)

    def _build_services(self, leaving: contextlib.ExitStack) -> None:
        address, access = self._address, self._access
        self.announcer = Announcer(self.transport, address)
        leaving.callback(self.announcer.close)
        self.providers = Providers(
            self.announcer, self.registry, address, self.codec, self.event_loop, self.locks, access, self.audit
        )
        self.targets = Targets(access, self.registry, self.providers, self.caller, self.codec, self.audit)
        self.registry.changes.subscribe(self.targets.changed)  # before all other subscribers: they may make calls

    def _build_notifications_and_hooks(self, leaving: contextlib.ExitStack) -> None:
        self.registry.changes.subscribe(self.notifier.changed)
        self.events.occurred.subscribe(lambda occurred: self.notifier.occurred(*occurred))
        self.session_end.subscribe(self.notifier.session_ended)
        copies = CallCopies(self.codec)
        self.guards = Guards(self._home, copies, self.providers.prepare_again)
        leaving.callback(self.guards.pool.close)
        self.providers.prepare = self.guards.apply
        self.hooks = Hooks(
            self._home,
            copies,
            self.scheduler,
            self._settings.hook_limit_s,
            self.providers.service,
            lambda: self.registry.select(where.local),
            self._denied_hook,
        )
        self.registry.changes.subscribe(self.hooks.changed)
        self.session_end.subscribe(self.hooks.session_ended)

    def _build_telemetry(self, leaving: contextlib.ExitStack) -> None:
        exported = open_export(self._settings, self._address, leaving)
        self.spans = new_spans(self._address, self._session, self.locks, exported)
        self.trace(self._settings.trace)

    def _build_streams(self, leaving: contextlib.ExitStack) -> None:
        home = self._home
        self.streams = Streams(home, self.transport, self.providers.service, self.scheduler, self.caller.new_id)
        self.registry.changes.subscribe(self.streams.changed)
        self.session_end.subscribe(self.streams.session_ended)
        leaving.callback(self.streams.close)
        self.subscriptions = Subscriptions(home, self.transport, self.scheduler, self.codec, self.registry.removed)
        self.registry.changes.subscribe(self.subscriptions.changed)
        self.session_end.subscribe(self.subscriptions.session_ended)
        leaving.callback(self.subscriptions.close)

    def _build_estop(self, leaving: contextlib.ExitStack) -> None:
        self.estop = EstopController(
            self.transport,
            self._address,
            self.registry,
            self.locks,
            self.providers,
            self._settings,
            self._access,
            self.audit,
        )
        leaving.callback(self.estop.close)
        self.deadman = self.estop.deadman
        self.locks.stop_with(self.deadman.stop)

    def _build_migration(self, leaving: contextlib.ExitStack) -> None:
        home, address, access = self._home, self._address, self._access
        self.withdrawn = Withdrawn(self.providers, self.deadman.rest)
        state_dir = self._settings.state_dir
        kept = None if state_dir is None else state_dir / self._settings.system / "code"
        code = CodeStore(kept, self._settings.code, address.container)
        self.factory = ProviderFactory(home, self.providers, self.withdrawn, self._settings.instantiable, code)
        leaving.callback(self.factory.close)
        quiescer = Quiescer(self.locks, address)
        self.migration_source = MigrationSource(
            home, self.providers, self.factory, self.withdrawn, quiescer, access, self.codec
        )
        self.migration_target = MigrationTarget(
            address, self.providers, self.factory, quiescer, access, self.codec, self.scheduler
        )
        leaving.callback(self.migration_target.close)

    def _build_dispatch(self, leaving: contextlib.ExitStack) -> None:
        self.dispatcher = Dispatcher(
            self.transport, self._address, self.providers, self.event_loop, self._access, self.audit
        )
        leaving.callback(self.dispatcher.close)
        self.local_server: LocalServer | None = None
        if self.local_path is not None:
            self._take_local_calls(self.local_path.passport)

    def _take_local_calls(self, passport: Passport) -> None:
        try:
            listening = listen_on_host(self._settings.system, MARK, self._address.epoch)
            host_sockets(self._settings.system, MARK)  # this removes those of ended processes
        except (OSError, TradeError) as bad:
            _logger.warning("no local path here: %s. Calls from this host take the transport, which is slower", bad)
            return
        if listening is not None:
            self.local_server = LocalServer(*listening, passport, self.dispatcher, self._caller_ended)
            self.dispatcher.pools.append(self.local_server)

    def _build_stop_line(self, leaving: contextlib.ExitStack) -> None:
        self.stop_lines = StopLines(self._settings, lambda: () if self.stop_line is None else self.stop_line.own_places)
        self.stop_line: StopLineService | None = None
        """Its service of the stop line; None on a transport without a host."""
        if self.dialer is not None:
            self.stop_line = StopLineService(
                self._address, self._settings, self._access, self.audit, self.estop, self.stop_for
            )
            leaving.callback(self.stop_line.close)
            self.registry.changes.subscribe(self._mind_stops)
            if self._settings.bridge:
                self.stop_line.listen_on_host()

    def _build_states(self) -> None:
        self.states = States(
            self._home.name,
            self.events,
            self.registry,
            self.dialer,
            self._links,
            self._certificate,
            self._settings.bridge,
            self.caller.answers,
            self.spans,
            self.trace,
        )
        self.registry.changes.subscribe(self.states.changed)
        suspended = self.states.hook_suspended
        self.hooks.suspended.subscribe(lambda hook: suspended(hook.name, hook.last_error, hook.called))
        self.streams.notify = self.states.listener_changed

    def _build_measures(self, leaving: contextlib.ExitStack) -> None:
        self.load_meter = LoadMeter(self._home.name, lambda: list(self.dispatcher.pools), self.providers.waiting)
        self.shutdown = Shutdown(
            self._home.name, self.deadman.rest, self.locks.resources, lambda: self.load_meter.running, self._home.close
        )
        self.metrics_port = open_metrics(self._settings, self.audit.calls, self._measures, leaving)

    def appear(self, own: object, estops: object) -> None:
        """Announces the container to others, with the middleware's own services. Closes everything on failure.

        Args:
            own: the provider of all services but e-stops.
            estops: the provider of e-stops.
        """
        with contextlib.ExitStack() as undone:
            undone.callback(self.close)
            self.providers.add(own, (DOMAIN,), name=PROVIDER)
            self.providers.add(estops, (DOMAIN,), name=ESTOP_PROVIDER)
            self.estop.begin(estops, self.stop_lines.estop, partial(RelayedEstop, self._home, self.registry))
            self._leaving.callback(self.announcer.appear().close)
            self.watch = RegistryListener(
                self.transport,
                self.registry,
                self._home.address,
                self._lost,
                self.session_ended,
                self.locks.session_back,
                self._beat,
                self.estop.learn,
            )
            self._leaving.callback(self.watch.close)
            if self._home.access.path is not None:
                begin_watching(self._home.access, self.scheduler, self.audit, self.recheck_access)
            undone.pop_all()

    def stop_for(self, who: str, group: str, limit_s: float, known: Sequence[str] = ()) -> StopReport:
        """Calls the stop services of a group that are known here, in a session of the client that asks.

        Args:
            who: the client.
            group: what to stop, with all groups beneath it.
            limit_s: how long to wait, in seconds.
            known: the keys of services that the client stops itself.
        """
        until = time.monotonic() + limit_s
        with session_for(self._address, who).use():
            return GroupStop(self._home, self.registry, group, None, known).wait(until, lambda: True)

    def stop(self, group: str, reason: str = "", *, limit_s: float = LIMIT_S) -> StopReport:
        """Calls all stop services of a group at once, and waits until what they stop is at rest (S07).

        It needs no lock and no existing link: it also asks containers on the stop line, and each container that it sees
        stops what only that one sees. A service that any of them stopped is stopped. Read the report:
        `StopReport.complete`. This is software, not safety-rated.

        Args:
            group: such as ``rosie.left``, with all groups beneath it.
            reason: why, for the record.
            limit_s: how long to try, in seconds; also if nothing is found, and a container may be missing.

        Raises:
            ConfigurationError: the group or the limit is not valid.
        """
        check_limit(limit_s, "stop")
        until, wanted = time.monotonic() + limit_s, where(group=group)
        beside = self.stop_lines.stop(group, reason, limit_s)
        begun = GroupStop(self._home, self.registry, group, reason)

        def ready() -> bool:
            found = bool(self.registry.select(wanted)) or bool(begun.report().stopped)
            return found or (beside.over() and (bool(beside.report().stopped) or self._sees_all()))

        report = begun.wait(until, ready)
        return together(group, [report, beside.report() if report.complete else beside.wait()])

    def _sees_all(self) -> bool:
        """Whether no container is known to be missing: each has listed its services, and each dialled one is linked."""
        listed = all(state.heard.complete for state in self.registry.containers() if state.address != self._address)
        return listed and not (self.dialer is not None and self.dialer.unlinked())

    # --- handling events

    def _mind_stops(self, change: Change) -> None:
        """Listens on this host's stop line once there is something to stop here; called by the registry."""
        if self.stop_line is not None and any(record.local and is_stop(record) for record in change.joined):
            self.stop_line.listen_on_host()

    def _beat(self) -> None:
        """Announces the revision if it is due, and looks at the links; called every two seconds."""
        self.announcer.beat()
        self.states.links.infos()
        self._keep_files()

    def _keep_files(self) -> None:
        """Makes the files again by which others on this host reach this container, if they have vanished."""
        try:
            if isinstance(self.transport, ZenohTransport):
                self.transport.links.watch_addresses()
                self.transport.keep_files()
            if self.stop_line is not None:
                self.stop_line.keep_place()
            if self._secret:
                keep_secret(self._secret)
        except (OSError, TradeError) as bad:
            _logger.debug("the files of this container cannot be checked: %s", bad)

    def _lost(self, address: Address, *, back: bool = False) -> None:
        """Handles the loss, or the return, of a container; called by the registry listener."""
        self.caller.lost(address, back=back)
        if back:
            return
        self.lock_api.lease_client.lost(address)
        if self.inherited is not None:
            self.inherited.lost(address)
        self._caller_ended(address)

    def _caller_ended(self, address: Address) -> None:
        """Handles the end of a container as a caller; of one on this host, its process may be the first sign of it.

        Calls to it, and locks of its resources, wait for the transport's sign: its last answers may be under way.
        """
        self.dispatcher.hang_up(address)  # before its locks end: see `Caller` on answers that grant
        if self.locks.gone((str(address),)) is None:  # the other sign was earlier
            self.session_ended(str(address), f"its container {address.container} has ended or cannot be reached")
        self.dispatcher.forget(address)

    def session_ended(self, session: str, reason: str = "it was closed") -> None:
        """Ends a session: its later calls are refused, its locks are lost, and its motion stops."""
        self.locks.session_ended(session, reason)
        self.deadman.session_ended(session)
        self.dispatcher.session_ended(session)
        self.session_end.emit(session)

    def ask_for_release(self, holder: Holder, token: Token, who: str, reason: str) -> None:
        """Passes a release request to the holder of a lock; called by the lock services."""
        owner = Address(*holder.session.split("/")[:3])
        self._home.handle(ServiceKey(owner, DOMAIN, PROVIDER, "release_requested")).start(token, who, reason)

    def trace(self, on: bool) -> bool:
        """Switches the tracing of calls on or off. Returns whether it was on."""
        was = self.caller.spans is not None
        spans: Spans | None = self.spans if on else None
        self.hooks.trace(spans)
        self.caller.spans = spans
        return was

    def _measures(self) -> Iterator[Measure]:
        """The metrics, read on the thread of the metrics server."""
        infos, record = self.locks.infos(), self.audit.record
        yield Measure("calls", "Calls from other containers.", sum(self._taken()), kind="counter")
        yield Measure("calls_in_flight", "Calls from other containers that run now.", self.load_meter.running)
        yield Measure("calls_queued", "Calls that wait for the turn of a serial service.", self.providers.waiting())
        yield Measure("containers", "Containers in the registry, this one included.", len(self.registry.containers()))
        yield Measure(
            "dropped_messages",
            "Malformed, or of another version.",
            self.dropped_messages,
            kind="counter",
        )
        yield Measure("locks", "Locks that hold here.", len(infos))
        yield Measure("lock_waiters", "Clients that wait for one of them.", sum(len(info.waiting) for info in infos))
        yield Measure("estops_open", "E-stops that are open.", len(self.estop.open_here()))
        yield Measure("process_cpu_seconds", "Of the whole process.", time.process_time(), kind="counter")
        if (resident := resident_bytes()) is not None:
            yield Measure("process_resident_bytes", "Of the whole process.", resident)
        if record is not None:
            yield Measure("audit_rows", "Written to the audit record.", record.written, kind="counter")
            yield Measure("audit_lost", "Events that were not written to it.", record.lost, kind="counter")
            yield Measure("audit_queue", "Events that are not written yet.", record.waiting)
        for measure in list(self.measured):
            yield from measure()

    def _taken(self) -> list[int]:
        return [pool.taken for pool in list(self.dispatcher.pools)]

    def _denied_hook(self, who: str, record: Record) -> AccessDenied | None:
        return self._home.access.denied(who, "instrument", record.key.domain, record.label)

    def recheck_access(self) -> None:
        """Applies a changed policy: locks that it no longer allows are lost."""
        access = self._home.access
        self.targets.recheck_access()
        self.dispatcher.hear(access.callers())
        self.registry.recheck_access()
        self.hooks.recheck_access()
        self.streams.recheck_access()
        for info in self.locks.infos():
            held = [(name, self.providers.groups_of(name)) for name in info.resources]
            denied = access.denied_lock(info.holder.identity, held)
            if denied is not None:
                self.locks.lose(info.token.number, str(denied))

    # --- ending

    @property
    def dropped_messages(self) -> int:
        """Messages that were malformed or of another protocol version."""
        readers = (self.dispatcher, self.caller, self.watch, self.estop, self.subscriptions)
        return sum(reader.malformed for reader in readers)

    def close(self) -> None:
        """Closes all components."""
        self.dispatcher.leave()
        self.targets.close()
        self._leaving.close()

    def abandon(self) -> None:
        """Closes nothing but connections, in a forked child."""
        self.targets.close()
        for local in (self.local_path, self.local_server):
            if local is not None:
                local.abandon()
        self._leaving.pop_all()
