"""The components of a container: built in order, each from earlier ones, and closed in reverse order."""

import contextlib
import logging
import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Final

from trade._audit.setup import open_audit
from trade._calls.caller import Caller
from trade._calls.client import CallClient
from trade._calls.handle import handle_codec
from trade._calls.local_path import MARK, LocalPath
from trade._calls.sessions import Sessions
from trade._calls.target_cache import Targets
from trade._container.certificate_end import ExpiryWatch
from trade._container.policy_reload import begin_watching
from trade._container.registration import Registration
from trade._container.shutdown import Shutdown
from trade._context.call_context import running
from trade._context.outgoing import handed_down
from trade._counters import Measure
from trade._discovery.announcer import Announcer
from trade._discovery.dialer import Dialer
from trade._discovery.join import join
from trade._discovery.listener import RegistryListener
from trade._discovery.resync import introduction_s
from trade._estop.controller import EstopController, is_stop
from trade._federation.federation import Federation
from trade._hooks.api import HookApi
from trade._hooks.guard import Guards
from trade._hooks.hook import CallCopies, Hooks
from trade._locks.api import LockApi
from trade._locks.inherited import InheritedLock
from trade._locks.remote_locks import RemoteLocks
from trade._migration.api import MigrationApi
from trade._migration.delivered_code import CodeStore
from trade._migration.factory import ProviderFactory
from trade._migration.quiesce import Quiescer
from trade._migration.source import MigrationSource
from trade._migration.target import MigrationTarget
from trade._notifications.api import NotificationApi
from trade._notifications.events import EventLog
from trade._notifications.notifier import Notifier
from trade._notifications.states import States
from trade._registry.constraints import where
from trade._registry.listing import containers_of
from trade._registry.registry import Change, Record, Registry
from trade._resources.lock_table import LockTable
from trade._resources.resource import Holder
from trade._security.authorizer import Authorizer
from trade._services.dispatcher import Dispatcher
from trade._services.event_loop import AsyncLoop
from trade._services.local_server import LocalServer
from trade._services.providers import Providers
from trade._services.withdrawn import WithdrawnProviders
from trade._settings import Settings
from trade._streams.api import StreamApi
from trade._streams.source import Streams
from trade._streams.subscriptions import Subscriptions
from trade._table import Table
from trade._telemetry.load import LoadMeter, resident_bytes
from trade._telemetry.otlp import open_export
from trade._telemetry.prometheus import open_metrics
from trade._telemetry.spans import Spans, new_spans
from trade._threads.event import Event
from trade._threads.scheduler import Scheduler
from trade._tracing.api import TraceApi
from trade.errors import AccessDenied, ConfigurationError, TradeError
from trade.protocol.container_info import ContainerInfo
from trade.protocol.keys import DOMAIN, ESTOP_PROVIDER, PROVIDER, Address, ServiceKey, bridge_key
from trade.protocol.messages import Token
from trade.stop_line import RelayedEstop, StopApi, StopLines, StopLineService
from trade.transport.base import ChannelClosed, Transport
from trade.transport.credentials import keep_secret, user_secret
from trade.transport.host_socket import host_sockets, listen_on_host
from trade.transport.local_greeting import Passport
from trade.transport.zenoh import ZenohTransport

_logger = logging.getLogger("trade")


class Components:
    """The components of one container, and which of them owns which data.

    Args:
        container: whose components they are.
        address: its address.
        settings: its settings.
        transport: carries everything, if it is given.
        on_terminate: called when a client has ended the container.
    """

    def __init__(
        self,
        container: object,
        address: Address,
        settings: Settings,
        transport: Transport | None,
        on_terminate: Callable[[], None],
    ) -> None:
        self._container = container
        self._address = address
        self._session = str(address)
        self._on_terminate = on_terminate
        self.settings: Final = settings
        self.access: Final = Authorizer(settings.policy, certified=settings.tls is not None)
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
            self._build_federation()
            self._leaving = leaving.pop_all()

    def _build_transport(self, leaving: contextlib.ExitStack, transport: Transport | None) -> None:
        self.audit = open_audit(self.settings, self._address, leaving)
        self._transport_is_given = transport is not None
        """Whether the transport was given: then it carries everything."""
        self.events = EventLog(self._address.container)
        self._certificate = None if self._transport_is_given else self.settings.certificate()
        self.transport = transport or join(self.settings, self._certificate, leaving)
        leaving.callback(self.transport.close)
        self._timers = Scheduler("trade-timers", self.transport.clock)
        """Has a fixed number of tasks, fewer than it may have threads. So none waits for another one that blocks."""
        leaving.callback(self._timers.close)
        self._real_timers = Scheduler("trade-timers") if self._transport_is_given else self._timers
        """The same on the computer's clock, where a test may move the other one."""
        leaving.callback(self._real_timers.close)
        if self._certificate is not None:
            ends = partial(self.events.note, "certificate_ends", self._address.identity)
            ExpiryWatch(self._certificate, self._real_timers, ends)
        self.dialer: Dialer | None = None
        """Its links; None on a transport without links."""
        own_pair = not self._transport_is_given and self.settings.tls is None and self.settings.credentials is None
        self._secret = user_secret()[1] if own_pair else ""
        """The secret of this user on this host, if the container's links use it."""
        self._links = self.transport.links if isinstance(self.transport, ZenohTransport) else None
        if isinstance(self.transport, ZenohTransport):
            self.dialer = Dialer(
                self.transport.links, self.settings.check_may_dial, self._timers, self.settings.connect
            )
            leaving.callback(self.dialer.close)

    def _build_calls(self, leaving: contextlib.ExitStack) -> None:
        address = self._address
        self.registry = Registry(address, self.access.may_offer, self.access.may_have_stops)
        self.client = CallClient(address, self.settings.system, self.registry, self.dialer, self.access)
        self.codec = handle_codec(lambda handle: handle.key, self.client.handle)
        self.local_path = self._local_path()
        self.caller = Caller(self.transport, address, self._timers, self.local_path)
        leaving.callback(self.caller.close)
        self.scheduler = Scheduler("trade-clock")
        leaving.callback(self.scheduler.close)
        notified = Scheduler("trade-notifications", self.transport.clock)
        leaving.callback(notified.close)
        self.notifier = Notifier(self.client, notified)
        leaving.callback(self.notifier.close)
        self.sessions = Sessions(address, self.transport, self.session_ended)

    def _local_path(self) -> LocalPath | None:
        """The local path to others; None if it is switched off, or the transport was given."""
        settings = self.settings
        if not settings.local_path or self._transport_is_given:
            return None
        password = "" if settings.tls is not None else "\n".join(settings.credentials or user_secret())
        return LocalPath(settings.system, Passport(self._address, settings.certificate, password))

    def _build_locks(self, leaving: contextlib.ExitStack) -> None:
        address = self._address
        self.inherited = InheritedLock(self.settings.lock, address) if self.settings.lock else None
        if self.inherited is not None:
            handed_down[address] = self.inherited
            leaving.callback(handed_down.pop, address)
        self.event_loop = AsyncLoop()
        leaving.callback(self.event_loop.close)
        self.lock_api = LockApi(self.client, self._timers)
        self.locks = LockTable(address.epoch, self._address.container, self._timers, self.audit)
        leaving.callback(self.locks.close)
        self.remote_locks = RemoteLocks(self.locks, address.epoch)

    def _build_services(self, leaving: contextlib.ExitStack) -> None:
        address, access = self._address, self.access
        self.announcer = Announcer(self.transport, address)
        leaving.callback(self.announcer.close)
        self.providers = Providers(
            self.announcer, self.registry, address, self.codec, self.event_loop, self.locks, access, self.audit
        )
        self.targets = Targets(access, self.registry, self.providers, self.caller, self.codec, self.audit)
        self.client.begin_calls(self.targets)
        self.registry.changes.subscribe(self.targets.changed)  # before all other subscribers: they may make calls

    def _build_notifications_and_hooks(self, leaving: contextlib.ExitStack) -> None:
        self.registry.changes.subscribe(self.notifier.changed)
        self.events.occurred.subscribe(lambda occurred: self.notifier.occurred(*occurred))
        self.session_end.subscribe(self.notifier.session_ended)
        copies = CallCopies(self.codec)
        self.guards = Guards(self.client, copies, self.providers.prepare_again)
        leaving.callback(self.guards.pool.close)
        self.providers.prepare = self.guards.apply
        self.hooks = Hooks(
            self.client,
            copies,
            self.scheduler,
            self.settings.hook_limit_s,
            self.providers.service,
            lambda: self.registry.select(where.local),
            self._denied_hook,
        )
        self.registry.changes.subscribe(self.hooks.changed)
        self.session_end.subscribe(self.hooks.session_ended)
        self.notification_api = NotificationApi(self.client, self.notifier)
        self.hook_api = HookApi(self.client, self.notification_api)

    def _build_telemetry(self, leaving: contextlib.ExitStack) -> None:
        exported = open_export(self.settings, self._address, leaving)
        self.spans = new_spans(self._address, self._session, self.locks, exported)
        self.trace(self.settings.trace)
        self.trace_api = TraceApi(self.client)

    def _build_streams(self, leaving: contextlib.ExitStack) -> None:
        self.streams = Streams(self.client, self.transport, self.providers.service, self.scheduler, self.caller.new_id)
        self.registry.changes.subscribe(self.streams.changed)
        self.session_end.subscribe(self.streams.session_ended)
        leaving.callback(self.streams.close)
        self.subscriptions = Subscriptions(
            self.client, self.transport, self.scheduler, self.codec, self.registry.removed
        )
        self.registry.changes.subscribe(self.subscriptions.changed)
        self.session_end.subscribe(self.subscriptions.session_ended)
        leaving.callback(self.subscriptions.close)
        self.stream_api = StreamApi(self.client, self.subscriptions, self.scheduler)

    def _build_estop(self, leaving: contextlib.ExitStack) -> None:
        self.estop = EstopController(
            self.transport,
            self._address,
            self.registry,
            self.locks,
            self.providers,
            self.settings,
            self.access,
            self.audit,
        )
        leaving.callback(self.estop.close)
        self.deadman = self.estop.deadman
        self.locks.stop_with(self.deadman.stop)

    def _build_migration(self, leaving: contextlib.ExitStack) -> None:
        address, access = self._address, self.access
        self.withdrawn_providers = WithdrawnProviders(self.providers, self.deadman.rest)
        self.registration = Registration(self.client, self.providers, self.withdrawn_providers, self.deadman)
        state_dir = self.settings.state_dir
        kept = None if state_dir is None else state_dir / self.settings.system / "code"
        code = CodeStore(kept, self.settings.code, address.container)
        self.factory = ProviderFactory(
            self._container,
            address,
            self.registration.register,
            self.providers,
            self.withdrawn_providers,
            self.settings.instantiable,
            code,
        )
        leaving.callback(self.factory.close)
        quiescer = Quiescer(self.locks, address)
        self.migration_source = MigrationSource(
            self.client, self.providers, self.factory, self.withdrawn_providers, quiescer, access, self.codec
        )
        self.migration_target = MigrationTarget(
            address, self.providers, self.factory, quiescer, access, self.codec, self.scheduler
        )
        leaving.callback(self.migration_target.close)
        self.migration_api = MigrationApi(self.client)

    def _build_dispatch(self, leaving: contextlib.ExitStack) -> None:
        self.dispatcher = Dispatcher(
            self.transport,
            self._address,
            self.providers,
            self.event_loop,
            self.access,
            self.audit,
            self._real_timers,
        )
        leaving.callback(self.dispatcher.close)
        self.local_server: LocalServer | None = None
        if self.local_path is not None:
            self._take_local_calls(self.local_path.passport)

    def _take_local_calls(self, passport: Passport) -> None:
        try:
            listening = listen_on_host(self.settings.system, MARK, self._address.epoch)
            host_sockets(self.settings.system, MARK)  # this removes those of ended processes
        except (OSError, TradeError) as bad:
            _logger.warning("no local path here: %s. Calls from this host take the transport, which is slower", bad)
            return
        if listening is not None:
            self.local_server = LocalServer(*listening, passport, self.dispatcher, self._caller_ended)
            self.dispatcher.pools.append(self.local_server)

    def _build_stop_line(self, leaving: contextlib.ExitStack) -> None:
        self.stop_lines = StopLines(self.settings, lambda: () if self.stop_line is None else self.stop_line.own_places)
        self.stop_api = StopApi(self.client, self.stop_lines)
        self.stop_line: StopLineService | None = None
        """Its service of the stop line; None on a transport without a host."""
        if self.dialer is not None:
            self.stop_line = StopLineService(
                self._address, self.settings, self.access, self.audit, self.estop, self.stop_api.stop_for
            )
            leaving.callback(self.stop_line.close)
            self.registry.changes.subscribe(self._mind_stops)
            if self.settings.bridge:
                self.stop_line.listen_on_host()

    def _build_states(self) -> None:
        self.states = States(
            self._address.container,
            self.events,
            self.registry,
            self.dialer,
            self._links,
            self._certificate,
            self.settings.bridge,
            self.caller.answers,
            self.spans,
            self.trace,
        )
        self.registry.changes.subscribe(self.states.changed)
        suspended = self.states.hook_suspended
        self.hooks.suspended.subscribe(lambda hook: suspended(hook.name, hook.last_error, hook.called))
        self.streams.notify = self.states.listener_changed

    def _build_federation(self) -> None:
        self.federation = Federation(
            self.client,
            self.providers,
            self.locks,
            self.remote_locks,
            self.lock_api.lease_client,
            self.estop,
            self.event_loop,
        )

    def _build_measures(self, leaving: contextlib.ExitStack) -> None:
        self.load_meter = LoadMeter(
            self._address.container, lambda: list(self.dispatcher.pools), self.providers.waiting
        )
        self.shutdown = Shutdown(
            self._address.container,
            self.deadman.rest,
            self.locks.resources,
            lambda: self.load_meter.running,
            self._on_terminate,
        )
        self.metrics_port = open_metrics(self.settings, self.audit.calls, self._measures, leaving)

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
            self.estop.begin(estops, self.stop_lines.estop, partial(RelayedEstop, self.client))
            self._leaving.callback(self.announcer.appear().close)
            if self._links is not None and self._links.bridges:
                self._leaving.callback(self.transport.appear(bridge_key(self._address)).close)
            self.watch = RegistryListener(
                self.transport,
                self.registry,
                self._address,
                self._lost,
                self.session_ended,
                self.locks.session_back,
                self._beat,
                self.estop.learn,
                self._real_timers,
            )
            self._leaving.callback(self.watch.close)
            if self.transport.relayed:
                at_s = self._real_timers.clock.now() + introduction_s(self.registry)
                self._leaving.callback(self._real_timers.begin(self._introduce, at_s * 1e9).cancel)
            self.watch.sync()
            if self.access.path is not None:
                begin_watching(self.access, self.scheduler, self.audit, self.recheck_access)
            undone.pop_all()

    # --- handling events

    def _mind_stops(self, change: Change) -> None:
        """Listens on this host's stop line once there is something to stop here; called by the registry."""
        if self.stop_line is not None and any(record.local and is_stop(record) for record in change.joined):
            self.stop_line.listen_on_host()

    def _introduce(self) -> None:
        with contextlib.suppress(ChannelClosed):
            self.announcer.introduce()

    def _beat(self) -> None:
        """Announces the revision if it is due, and looks at the links; called every two seconds."""
        self.announcer.beat(len(self.registry.containers()))
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
        try:
            self.dispatcher.hang_up(address)  # before its locks end: see `Caller` on answers that grant
        finally:
            if self.locks.session_error((str(address),)) is None:  # the other sign was earlier
                self.session_ended(str(address), f"its container {address.container} has ended or cannot be reached")
        self.dispatcher.forget(address)

    def session_ended(self, session: str, reason: str = "it was closed") -> None:
        """Ends a session: its later calls are refused, its locks are lost, and its motion stops."""
        self.locks.session_ended(session, reason)
        self.deadman.session_ended(session)
        self.dispatcher.session_ended(session)
        self.session_end.emit(session)

    def ask_for_release(self, holder: Holder, token: Token, identity: str, reason: str) -> None:
        """Passes a release request to the holder of a lock; called by the lock services."""
        owner = Address(*holder.session.split("/")[:3])
        self.client.handle(ServiceKey(owner, DOMAIN, PROVIDER, "release_requested")).start(token, identity, reason)

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

    def _denied_hook(self, identity: str, record: Record) -> AccessDenied | None:
        return self.access.denied(identity, "instrument", record.key.domain, record.label)

    def recheck_access(self) -> None:
        """Applies a changed policy: locks that it no longer allows are lost."""
        access = self.access
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

    # --- its set-up

    @property
    def reach(self) -> Dialer:
        """Its links; raises ConfigurationError on a transport without links."""
        self.client.check_open()
        if self.dialer is None:
            raise ConfigurationError(problem="this container's transport cannot change its links while it runs")
        return self.dialer

    def load_policy(self, path: Path | str) -> None:
        """Loads another access policy, or the same file again; calls under way continue.

        A container that was started with a policy (`Settings.policy`) reads it again when its files change; so it does
        with a policy that is loaded here.

        Services that the policy no longer allows leave the registry, and locks that it no longer allows are lost.

        Raises:
            ConfigurationError: the policy is wrong; the message says where. The earlier policy stays in force.
        """
        self.client.check_open()
        self.access.load(Path(path))
        self.audit.changed("policy loaded", str(path), running.get())
        self.recheck_access()

    def containers(self) -> Table[ContainerInfo]:
        """The containers of the system, this one included."""
        return containers_of(self.registry)

    # --- ending

    @property
    def dropped_messages(self) -> int:
        """Messages that were malformed or of another protocol version."""
        readers = (self.dispatcher, self.caller, self.watch, self.estop, self.subscriptions)
        return sum(reader.malformed for reader in readers)

    def close(self) -> None:
        """Closes all components."""
        self.client.close()
        self.dispatcher.leave()
        self.targets.close()
        self._leaving.close()

    def abandon(self) -> None:
        """Closes nothing but connections, in a forked child."""
        self.client.close()
        self.targets.close()
        for local in (self.local_path, self.local_server):
            if local is not None:
                local.abandon()
        self._leaving.pop_all()
