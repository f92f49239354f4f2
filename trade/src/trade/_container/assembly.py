"""What a container is made of: made in order, each from those before it; ended in the reverse order."""

import contextlib
import itertools
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Final, Protocol

from trade._audit.events import open_audit
from trade._calls.caller import Caller
from trade._calls.handle import CallHost, Handle
from trade._calls.handle_codec import handle_codec
from trade._calls.target_cache import Targets
from trade._container.connect import join
from trade._container.policy_reload import begin_watching
from trade._container.shutdown import Shutdown
from trade._context.call_context import handed_down
from trade._counters import Measure
from trade._discovery.announcer import Announcer
from trade._discovery.dialer import Dialer
from trade._discovery.listener import RegistryListener
from trade._estop.controller import EstopController, check_limit, is_stop
from trade._hooks import hook
from trade._hooks.hook import Hooks
from trade._locks import api
from trade._locks.api import LockApi
from trade._locks.inherited import InheritedLock
from trade._locks.remote_locks import RemoteLocks
from trade._migration import factory
from trade._migration.factory import ProviderFactory
from trade._migration.quiesce import Quiescer
from trade._migration.source import MigrationSource
from trade._migration.target import MigrationTarget
from trade._notifications import notification
from trade._notifications.notifier import Notifier
from trade._protocol.keys import DOMAIN, ESTOP_PROVIDER, PROVIDER, Address, ServiceKey
from trade._protocol.messages import Token
from trade._registry.constraints import where
from trade._registry.registry import Change, Record, Registry
from trade._resources.lock_table import LockTable
from trade._resources.resource import Holder
from trade._services.dispatcher import Dispatcher
from trade._services.event_loop import AsyncLoop
from trade._services.providers import Providers
from trade._services.withdrawn import Withdrawn
from trade._settings import Settings
from trade._stop_line import StopLines, StopLineService, StopReport, stop_group, stops_of, together
from trade._streams import source as _streams
from trade._streams.source import Streams
from trade._streams.subscriptions import Subscriptions
from trade._telemetry.load import LoadMeter, resident_bytes
from trade._telemetry.otlp import open_export
from trade._telemetry.prometheus import open_metrics
from trade._telemetry.spans import Spans, new_spans
from trade._threads.scheduler import Scheduler
from trade._transport.base import Transport
from trade._transport.zenoh import ZenohTransport
from trade.errors import AccessDenied

_LOOK_S: Final = 0.1


class Host(
    hook.HookHost,
    api.LockHost,
    factory.FactoryHost,
    notification.NotificationHost,
    _streams.StreamHost,
    CallHost,
    Protocol,
):
    """The container, as what it is made of sees it."""

    def close(self) -> None: ...


class Components:
    """One of each. Data has one owner, and here one sees which."""

    def __init__(self, home: Host, settings: Settings, transport: Transport | None) -> None:
        self._home = home
        address, access = home.address, home.access
        epoch, session = address.epoch, str(address)
        self.session_end_listeners: Final[list[Callable[[str], None]]] = []
        """Told of every session that ends."""
        with contextlib.ExitStack() as leaving:  # what has begun ends again if the rest cannot begin
            self.audit = open_audit(settings, address, leaving)
            self.transport = transport or join(settings, leaving)
            leaving.callback(self.transport.close)
            self.reach: Dialer | None = None
            """Its links; None on a transport that has no such switches."""
            if isinstance(self.transport, ZenohTransport):
                self.reach = Dialer(self.transport.links, settings.check_may_dial, settings.connect)
                leaving.callback(self.reach.close)
            self.codec = handle_codec(lambda handle: handle.key, home.handle)
            self.registry = Registry(address, access.may_offer, access.may_have_stops)
            self.caller = Caller(self.transport, address, session)
            leaving.callback(self.caller.close)
            self.clockwork = Scheduler("trade-clock")
            leaving.callback(self.clockwork.close)
            self.notifier = Notifier(home, self.clockwork, epoch, lambda record: Handle(home, record.key, record))
            leaving.callback(self.notifier.close)
            self.inherited = InheritedLock(settings.lock, address) if settings.lock else None
            if self.inherited is not None:
                handed_down[address] = self.inherited
                leaving.callback(handed_down.pop, address)
            self.coroutines = AsyncLoop()
            leaving.callback(self.coroutines.close)
            self.locking = LockApi(home)
            self.locks = LockTable(epoch, home.name, audit=self.audit)
            leaving.callback(self.locks.close)
            self.borrowed = RemoteLocks(self.locks, epoch)
            self.announcer = Announcer(self.transport, address)
            leaving.callback(self.announcer.close)
            self.providers = Providers(
                self.announcer, self.registry, address, self.codec, self.coroutines, self.locks, access, self.audit
            )
            self.targets = Targets(
                address, session, access, self.registry, self.providers, self.caller, self.codec, self.audit
            )
            self.registry.listen(self.targets.changed)  # before anybody is told: who is told may call
            self.registry.listen(self.notifier.changed)
            self.session_end_listeners.append(self.notifier.session_ended)
            self.hooks = Hooks(
                home,
                self.codec,
                self.clockwork,
                self.providers.service,
                lambda: self.registry.select(where.local),
                self._denied_hook,
            )
            self.registry.listen(self.hooks.changed)
            self.session_end_listeners.append(self.hooks.session_ended)
            self.hook_numbers = itertools.count(1)
            self.spans = new_spans(address, session, self.locks, open_export(settings, address, leaving))
            self.trace(settings.trace)
            self.streams = Streams(home, self.transport, self.providers.service, self.clockwork, self.caller.new_id)
            self.registry.listen(self.streams.changed)
            self.session_end_listeners.append(self.streams.session_ended)
            leaving.callback(self.streams.close)
            self.listening = Subscriptions(home, self.transport, self.clockwork, self.codec, self.registry.removed)
            self.registry.listen(self.listening.changed)
            self.session_end_listeners.append(self.listening.session_ended)
            leaving.callback(self.listening.close)
            kept = None if settings.state_dir is None else settings.state_dir / settings.system / "estop"
            self.estopping = EstopController(
                self.transport, address, self.registry, self.locks, self.providers, kept, access, self.audit
            )
            leaving.callback(self.estopping.close)
            self.deadman = self.estopping.deadman
            self.locks.stop_with(self.deadman.stop)
            self.withdrawn = Withdrawn(self.providers, self.deadman.rest)
            self.making = ProviderFactory(home, self.providers, self.withdrawn, settings.instantiable)
            leaving.callback(self.making.close)
            freezing = Quiescer(self.locks, address)
            self.departing = MigrationSource(
                home, self.providers, self.making, self.withdrawn, freezing, access, self.codec
            )
            self.arriving = MigrationTarget(
                address, self.providers, self.making, freezing, access, self.codec, self.clockwork
            )
            leaving.callback(self.arriving.close)
            self.dispatcher = Dispatcher(
                self.transport, address, self.providers.lookup, self.coroutines, access, self.audit, access.callers()
            )
            leaving.callback(self.dispatcher.close)
            self.lines = StopLines(settings, lambda: () if self.stop_line is None else self.stop_line.own_places)
            self.stop_line: StopLineService | None = None
            """Its own end of the stop line; None on a transport without a host."""
            if self.reach is not None:
                self.stop_line = StopLineService(address, settings, access, self.audit, self.estopping, self.stop_known)
                leaving.callback(self.stop_line.close)
                self.registry.listen(self._mind_stops)
                if settings.bridge:
                    self.stop_line.listen_on_host()
            self.meter = LoadMeter(home.name, lambda: list(self.dispatcher._crews), self.providers.waiting)
            self.terminating = Shutdown(
                home.name, self.deadman.rest, self.locks.resources, lambda: self.meter.running, home.close
            )
            self.measured: Final[list[Callable[[], Iterable[Measure]]]] = []
            """What else there is to measure, as whoever drives something tells it."""
            self.metrics_port = open_metrics(settings, self.audit.calls, self._measures, leaving)
            self._leaving = leaving.pop_all()

    def appear(self, own: object, estops: object) -> None:
        """Be there for others, who find these functions of the middleware's own. Ends everything if it cannot.

        Args:
            own: the provider of all but e-stops.
            estops: the one of e-stops.
        """
        with contextlib.ExitStack() as undone:
            undone.callback(self.close)
            self.providers.add(own, (DOMAIN,), name=PROVIDER)
            self.providers.add(estops, (DOMAIN,), name=ESTOP_PROVIDER)
            self.estopping.begin(estops, self.lines.estop)
            self._leaving.callback(self.announcer.appear().close)
            self.watch = RegistryListener(
                self.transport,
                self.registry,
                self._home.address,
                self._lost,
                self.session_ended,
                self.locks.session_back,
                self.announcer.beat,
                self.estopping.learn,
            )
            self._leaving.callback(self.watch.close)
            if self._home.access.path is not None:
                begin_watching(self._home.access, self.clockwork, self.audit, self.recheck_access)
            undone.pop_all()

    def stop_known(self, group: str, limit_s: float) -> StopReport:
        """Call the stop services of a group that are known here, for some seconds at most."""
        return stop_group(self._home, stops_of(self.registry, group), group, limit_s)

    def stop_all_of(self, group: str, reason: str, limit_s: float) -> StopReport:
        """See `Container.stop`."""
        check_limit(limit_s, "stop")
        until = time.monotonic() + limit_s
        wanted = where(group=group)
        beside = self.lines.stop(group, reason, limit_s)
        while not (self.registry.select(wanted) or beside.over()) and (left_s := until - time.monotonic()) > 0:
            self.registry.wait_for(lambda: bool(self.registry.select(wanted)), min(_LOOK_S, left_s))
        report = self.stop_known(group, max(_LOOK_S, until - time.monotonic()))
        return together(group, [report, beside.report() if report.complete else beside.wait()])

    # --- being told

    def _mind_stops(self, change: Change) -> None:
        """Told by the registry: once there is something to stop here, this host can ask for that."""
        if self.stop_line is not None and any(record.local and is_stop(record) for record in change.joined):
            self.stop_line.listen_on_host()

    def _lost(self, address: Address, *, back: bool = False) -> None:
        """Told by the watch: a container is out of sight, or there again."""
        self.caller.lost(address, back=back)
        if back:
            return
        self.locking.keeper.lost(address)
        if self.inherited is not None:
            self.inherited.lost(address)
        self.session_ended(str(address), f"its container {address.container} has ended or cannot be reached")
        self.dispatcher.forget(address)

    def session_ended(self, session: str, reason: str = "it was closed") -> None:
        """Nobody of it is there any more: nothing more is let in for it, its locks fall, what it moves stops."""
        self.locks.session_ended(session, reason)
        self.deadman.session_ended(session)
        self.dispatcher.session_ended(session)
        for tell in list(self.session_end_listeners):
            tell(session)

    def ask_for_release(self, holder: Holder, token: Token, who: str, reason: str) -> None:
        """Told by the lock services: somebody would like to have what another one holds."""
        owner = Address(*holder.session.split("/")[:3])
        self._home.handle(ServiceKey(owner, DOMAIN, PROVIDER, "release_requested")).start(token, who, reason)

    def trace(self, on: bool) -> bool:
        """Told by the settings, and by the trace services: note calls, or no more. Whether it did before."""
        was = self.caller.spans is not None
        spans: Spans | None = self.spans if on else None
        self.hooks.trace(spans)
        self.caller.spans = spans
        return was

    def _measures(self) -> Iterator[Measure]:
        """Asked for by the metrics, on a thread of theirs."""
        infos, record = self.locks.infos(), self.audit.record
        yield Measure("calls", "Calls from other containers.", sum(self._taken()), kind="counter")
        yield Measure("calls_in_flight", "Those of them that have a thread now.", self.meter.running)
        yield Measure("calls_queued", "Calls of serial services whose turn has not come.", self.providers.waiting())
        yield Measure("containers", "Containers that are seen, this one included.", len(self.registry.containers()))
        yield Measure("dropped_messages", "Malformed, or of another version.", self.dropped_messages, kind="counter")
        yield Measure("locks", "Locks that hold here.", len(infos))
        yield Measure("lock_waiters", "Who waits for one of them.", sum(len(info.waiting) for info in infos))
        yield Measure("estops_open", "E-stops that are open.", len(self.estopping.open_here()))
        yield Measure("process_cpu_seconds", "Of the whole process.", time.process_time(), kind="counter")
        if (resident := resident_bytes()) is not None:
            yield Measure("process_resident_bytes", "Of the whole process.", resident)
        if record is not None:
            yield Measure("audit_rows", "Written to the audit record.", record.written, kind="counter")
            yield Measure("audit_lost", "Events that were not written to it.", record.lost, kind="counter")
            yield Measure("audit_queue", "Events that are not written yet.", record.waiting)
        for tell in list(self.measured):
            yield from tell()

    def _taken(self) -> list[int]:
        return [crew.taken for crew in list(self.dispatcher._crews)]

    def _denied_hook(self, who: str, record: Record) -> AccessDenied | None:
        return self._home.access.denied(who, "instrument", record.key.domain, record.label)

    def recheck_access(self) -> None:
        """Told by the container: the policy is another one; locks that may no longer be held are lost."""
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
        readers = (self.dispatcher, self.caller, self.watch, self.estopping, self.listening)
        return sum(reader.malformed for reader in readers)

    def close(self) -> None:
        """End all of it."""
        self.dispatcher.leave()
        self.targets.close()
        self._leaving.close()

    def abandon(self) -> None:
        """In a forked child: end nothing."""
        self.targets.close()
        self._leaving.pop_all()
