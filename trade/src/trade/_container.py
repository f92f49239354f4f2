"""One participant: starts, joins, hosts providers, looks up, leaves. Ties the other modules together."""

import contextlib
import itertools
import secrets
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import msgspec

from trade import _process
from trade._access import Access
from trade._announcing import Announcer
from trade._arriving import Arriving
from trade._bordering import Bordering
from trade._borrowed import Borrowed
from trade._calls import Caller
from trade._clockwork import Clockwork
from trade._codec import Codec
from trade._constraints import where
from trade._context import handed_down
from trade._coroutines import AsyncLoop
from trade._departing import Departing
from trade._dispatch import Dispatcher
from trade._estopping import Estopping
from trade._freezing import Freezing
from trade._guarding import Guarding
from trade._handle import Handle, Run
from trade._hooks import Hooks
from trade._hosting import Hosting
from trade._inherited import InheritedLock
from trade._invoke import LocalTarget, RemoteTarget, container_closed
from trade._joining import join
from trade._listening import Listening
from trade._load import Load
from trade._locking import Locking
from trade._locks import LockTable
from trade._making import Making
from trade._moving import Moving
from trade._notifications import Notifier
from trade._own_services import OwnServices
from trade._providers import Providers
from trade._reach import Reach
from trade._registry import Change, Record, Registry, gone_to
from trade._request import new_request
from trade._resources import Holder
from trade._session import Session
from trade._settings import Settings
from trade._streaming import Streaming
from trade._streams import Streams
from trade._system import DOMAIN, PROVIDER, ContainerInfo, System
from trade._terminating import Terminating
from trade._tracing import Tracing, new_spans
from trade._transport import ChannelClosed, Transport
from trade._watch import Watch
from trade._wire import Address, ServiceKey, Token, alive_key, as_chunk, encode_message
from trade._withdrawn import Withdrawn
from trade._zenoh import ZenohTransport
from trade.errors import AccessDenied, ConfigurationError, ServiceGone

__all__ = ["Container"]

HANDLE_EXT: Final = 1
_PATIENCE_S: Final = 1.0
"""How long a call waits for the registry to hear of a handle that came by message before its registry entry did."""


class Container(Hosting, Moving, Streaming, Tracing, Guarding, Bordering):
    """A participant of a system; most programs use the default one through the functions of ``trade``.

    Joins on construction. A context manager; ``close()`` leaves and is idempotent.

    Raises:
        ConfigurationError: a setting is wrong, the endpoint is taken, or this process was forked from one that has a
            container.
    """

    def __init__(self, settings: Settings | None = None, *, transport: Transport | None = None) -> None:
        _process.refuse_after_fork()
        _process.note_start()
        self._settings = settings or Settings.read()
        self.address = Address(self._settings.identity, self._settings.container, secrets.token_hex(6))
        self.session = str(self.address)
        self._clients = itertools.count(1)
        self._told_of_ends: list[Callable[[str], None]] = []
        """Told of every session that ends."""
        self._closing = threading.RLock()
        self._closed = False
        self.system: Final = System(lambda: self)
        """Its own switches: who it is linked to, and whether it lets itself be found."""
        self.access = Access(self._settings.policy, certified=self._settings.tls is not None)
        """What the policy means for it."""
        self._targets: dict[ServiceKey, LocalTarget | RemoteTarget] = {}
        self._codec = Codec(self._handle_to_data, self._data_to_handle, (Handle,))
        self._registry = Registry(self.address, self.access.may_offer)
        with contextlib.ExitStack() as leaving:  # what has begun ends again if the rest cannot begin
            self._reach: Reach | None = None
            self._transport = transport or join(self._settings, leaving)
            leaving.callback(self._transport.close)
            if isinstance(self._transport, ZenohTransport):
                links, configured = self._transport.links, self._settings.connect
                self._reach = Reach(links, self._settings.check_may_dial, configured)
                leaving.callback(self._reach.close)
            self._caller = Caller(self._transport, self.address, self.session)
            leaving.callback(self._caller.close)
            clockwork = self._clockwork = Clockwork("trade-clock")
            leaving.callback(clockwork.close)
            epoch = self.address.epoch
            self._notifier = Notifier(self, clockwork, epoch, lambda record: Handle(self, record.key, record))
            leaving.callback(self._notifier.close)
            self._inherited = InheritedLock(self._settings.lock, self.address) if self._settings.lock else None
            if self._inherited is not None:
                handed_down[self.address] = self._inherited
                leaving.callback(handed_down.pop, self.address)
            self._registry.listen(self._changed)
            self._registry.listen(self._notifier.changed)
            self._told_of_ends.append(self._notifier.session_ended)
            coroutines = self._coroutines = AsyncLoop()
            leaving.callback(coroutines.close)
            self.locking = Locking(self)
            """Its locks on what others offer, and on what it offers itself."""
            self._table = LockTable(self.address.epoch, self.name)
            leaving.callback(self._table.close)
            self.borrowed = Borrowed(self._table, self.address.epoch)
            """What is locked in other systems behind its grants."""
            announcer = Announcer(self._transport, self.address)
            leaving.callback(announcer.close)
            self._providers = Providers(
                announcer, self._registry, self.address, self._codec, coroutines, self._table, self.access
            )
            self._hooks = Hooks(
                self,
                self._codec,
                clockwork,
                self._providers.service,
                lambda: self._registry.select(where.local),
                self._denied_hook,
            )
            self._registry.listen(self._hooks.changed)
            self._spans = new_spans(self.address, self.session, self._table)
            self._trace_here(self._settings.trace)
            self._told_of_ends.append(self._hooks.session_ended)
            self._hook_numbers = itertools.count(1)
            self._streams = Streams(self, self._transport, self._providers.service, clockwork, self._caller.new_id)
            self._registry.listen(self._streams.changed)
            self._told_of_ends.append(self._streams.session_ended)
            leaving.callback(self._streams.close)
            self._listening = Listening(self, self._transport, clockwork, self._codec, self._registry.removed)
            self._registry.listen(self._listening.changed)
            self._told_of_ends.append(self._listening.session_ended)
            leaving.callback(self._listening.close)
            state = self._settings.state_dir
            self._estopping = Estopping(
                self._transport,
                self.address,
                self._registry,
                self._table,
                self._providers,
                None if state is None else state / self._settings.system / "estop",
                self.access,
            )
            leaving.callback(self._estopping.close)
            self._deadman = self._estopping.deadman
            self._table.stop_with(self._deadman.stop)
            self.withdrawn = Withdrawn(self._providers, self._deadman.rest)
            """What was taken off from elsewhere and can be offered again."""
            self.making = Making(self, self._providers, self.withdrawn, self._settings.instantiable)
            """What it made for others."""
            leaving.callback(self.making.close)
            freezing = Freezing(self._table, self.address)
            departing = Departing(self, self._providers, freezing, self.access, self._codec)
            arriving = Arriving(self, self._providers, freezing, self.access, self._codec, clockwork)
            leaving.callback(arriving.close)
            self._dispatcher = Dispatcher(
                self._transport, self.address, self._providers.lookup, coroutines, self.access, self.access.callers()
            )
            leaving.callback(self._dispatcher.close)
            self.meter = Load(self.name, lambda: list(self._dispatcher._crews), self._providers.waiting)
            """How busy it is."""
            self.terminating = Terminating(
                self.name, self._deadman.rest, self._table.resources, lambda: self.meter.running, self.close
            )
            """Its end, if others want it."""
            own = OwnServices(
                self.system,
                self._table,
                self.address,
                self._ask_for_release,
                self.locking.keeper.asked,
                self._estopping,
                self.access,
                self._providers.groups_of,
                self.borrowed,
                self._notifier,
                self._registry,
                self._hooks,
                self,
                self._spans,
                self._trace_here,
                self._streams,
                departing,
                arriving,
            )
            self._providers.add(own, (DOMAIN,), name=PROVIDER)
            self._estopping.begin(own)
            presence = self._transport.appear(alive_key(self.address))
            leaving.callback(presence.close)
            self._watch = Watch(
                self._transport, self._registry, self.address, self._lost, self._session_ended, announcer.beat
            )
            leaving.callback(self._watch.close)
            self._leaving = leaving.pop_all()
        _process.live.add(self)

    def load_policy(self, path: Path | str) -> None:
        """Go by another access policy, or by the same file as it is now; calls under way go on.

        What may no longer be offered leaves the registry, and locks that may no longer be held are lost.

        Raises:
            ConfigurationError: it is wrong, and says where; what was loaded before stays.
        """
        self._check_open()
        self.access.load(Path(path))
        self._targets.clear()
        self._dispatcher.hear(self.access.callers())
        self._registry.judge_anew()
        self._hooks.judge_anew()
        self._streams.judge_anew()
        for info in self._table.infos():
            held = [(name, self._providers.groups_of(name)) for name in info.resources]
            denied = self.access.denied_lock(info.holder.identity, held)
            if denied is not None:
                self._table.lose(info.token.number, str(denied))

    # --- looking up

    def addresses(self) -> list[Address]:
        """Where the containers of the system are, this one included."""
        return [state.address for state in self._registry.containers()]

    def containers(self) -> list[ContainerInfo]:
        """The containers of the system, this one included."""
        self._check_open()
        infos: list[ContainerInfo] = []
        for state in self._registry.containers():
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
                )
            )
        return infos

    @property
    def reach(self) -> Reach:
        """Whom it is linked to; raises ConfigurationError on a transport that has no such switches."""
        self._check_open()
        if self._reach is None:
            raise ConfigurationError(problem="this container's transport cannot be linked to others while it runs")
        return self._reach

    def handle(self, key: ServiceKey) -> Handle:
        """A handle of a service whose key is known."""
        return Handle(self, key, self._registry.get(key))

    def has(self, key: ServiceKey) -> bool:
        """Whether the registry has the service now."""
        return self._registry.get(key) is not None

    def record(self, handle: Handle) -> Record:
        """What is known of a service; raises ServiceGone if nothing ever was."""
        record = self._registry.get(handle.key) or handle.last_record
        if record is None:
            raise self._gone(handle)
        return record

    # --- being told

    def _lost(self, address: Address, *, back: bool = False) -> None:
        """Told by the watch: a container is out of sight, or there again."""
        self._caller.lost(address, back=back)
        if not back:
            self.locking.keeper.lost(address)
            if self._inherited is not None:
                self._inherited.lost(address)
            self._session_ended(str(address), f"its container {address.container} has ended or cannot be reached")
        else:
            self._table.session_back(str(address))

    def _session_ended(self, session: str, reason: str = "it was closed") -> None:
        """Nobody of it is there any more: nothing more is let in for it, its locks fall, what it moves stops."""
        self._table.session_ended(session, reason)
        self._deadman.session_ended(session)
        for tell in list(self._told_of_ends):
            tell(session)

    def _ask_for_release(self, holder: Holder, token: Token, who: str, reason: str) -> None:
        """Told by the lock services: somebody would like to have what another one holds."""
        owner = Address(*holder.session.split("/")[:3])
        self.handle(ServiceKey(owner, DOMAIN, PROVIDER, "release_requested")).start(token, who, reason)

    def _changed(self, change: Change) -> None:
        """Told by the registry: calls to what left must fail at once."""
        for record in (*change.left, *change.replaced):
            self._targets.pop(record.key, None)
        for record in change.left:
            key = record.key
            if not record.local and (self._registry.removed(key) or not self._registry.is_alive(key.address)):
                self._caller.forget(key.address, key.domain, key.provider)

    # --- calling

    def invoke(self, handle: Handle, args: tuple[Any, ...], kwargs: dict[str, Any], deadline_s: float | None) -> Any:
        """Call a service and wait; what ``handle(...)`` does."""
        target = self._targets.get(handle.key)
        if target is not None:
            return target.call(args, kwargs, deadline_s)
        request = new_request(deadline_s)
        return self._new_target(handle).invoke(args, kwargs, request)

    def begin(self, handle: Handle, args: tuple[Any, ...], kwargs: dict[str, Any], deadline_s: float | None) -> Run:
        """Call a service without waiting; what ``handle.start(...)`` does."""
        request, run = new_request(deadline_s), Run(handle)
        self._target(handle).begin(args, kwargs, request, run)
        return run

    def _target(self, handle: Handle) -> LocalTarget | RemoteTarget:
        target = self._targets.get(handle.key)
        return target if target is not None else self._new_target(handle)

    def _new_target(self, handle: Handle) -> LocalTarget | RemoteTarget:
        self._check_open()
        key, policy = handle.key, self.access.policy
        known = self._registry.get(key) is not None or handle.last_record is not None or self._registry.removed(key)
        if not known:
            self._registry.wait_for(lambda: self._registry.get(key) is not None, _PATIENCE_S)
        record = self._registry.get(key)
        if record is not None:
            self.access.require_call(self.address.identity, key.domain, key.name, record.info.effect, record.label)
        target = None if record is None else self._make_target(record)
        if target is None:
            raise self._gone(handle)
        self._targets[key] = target
        changed = self._registry.get(key) is not record or self.access.policy is not policy
        if self._closed or changed:  # it left, or is another one, since we looked
            self._targets.pop(key, None)
        return target

    def _make_target(self, record: Record) -> LocalTarget | RemoteTarget | None:
        if not record.local:
            try:
                return RemoteTarget(record, self._caller, self._codec)
            except ChannelClosed:  # closed meanwhile
                raise container_closed(self.address) from None
        service = self._providers.lookup(f"{record.key.domain}/{record.key.provider}", record.key.name)
        if service is None:  # deregistered since we looked
            return None
        return LocalTarget(service, self._codec, self.address, self.session, self._caller.new_id)

    def _gone(self, handle: Handle) -> ServiceGone:
        address = handle.key.address
        if moved_to := self._registry.moved_to(handle.key):
            return gone_to(handle.label, moved_to)
        if self._registry.is_alive(address):
            reason = "its provider was deregistered" if self._registry.removed(handle.key) else "it is not known here"
        else:
            reason = f"container {address.container} has ended, restarted or cannot be reached"
        return ServiceGone(service=handle.label, reason=reason)

    def _handle_to_data(self, value: Any) -> Any:
        if isinstance(value, Handle):
            return msgspec.msgpack.Ext(HANDLE_EXT, encode_message(value.key))
        raise TypeError(f"a {type(value).__qualname__} is no plain data")

    def _data_to_handle(self, code: int, data: memoryview) -> Any:
        if code != HANDLE_EXT:
            raise msgspec.ValidationError(f"Unknown extension {code}")
        return self.handle(msgspec.msgpack.decode(data, type=ServiceKey))

    # --- being

    def open_session(self, client: str, *, system: str = "") -> Session:
        """A presence for one client of a program that acts for many: a page, a connection (S03).

        Inside ``with container.open_session("page"):`` calls and locks are the client's: when it is closed, what the
        client set moving stops and its locks fall, and nothing else does.

        Args:
            client: a word for it; others see ``identity/container/epoch/client.number``.
            system: the other system that it is of, if any; others are told ``system/client via identity``.

        Raises:
            ConfigurationError: the container is closed.
        """
        self._check_open()
        whose = f"{as_chunk(system)[:20]}:" if system else ""
        name = f"{self.address}/{whose}{as_chunk(client)[:40]}.{next(self._clients)}"
        try:
            presence = self._transport.appear(alive_key(name))
        except ChannelClosed:  # closed by another thread meanwhile
            raise container_closed(self.address) from None
        return Session(self.address, name, presence, self._session_ended)

    @property
    def name(self) -> str:
        """The container's name."""
        return self.address.container

    def require_call(self, who: str, handle: Handle) -> None:
        """Raises AccessDenied: somebody for whom this container acts may not call that service."""
        key, record = handle.key, handle.record
        self.access.require_call(who, key.domain, key.name, record.info.effect, record.label)

    def _denied_hook(self, who: str, record: Record) -> AccessDenied | None:
        return self.access.denied(who, "instrument", record.key.domain, record.label)

    @property
    def settings(self) -> Settings:
        """What it was started with."""
        return self._settings

    @property
    def dropped_messages(self) -> int:
        """Messages that were malformed or of another protocol version."""
        readers = (self._dispatcher, self._caller, self._watch, self._estopping, self._listening)
        return sum(reader.malformed for reader in readers)

    @property
    def catching_up(self) -> bool:
        """Whether it is asking others for what it may have missed."""
        return self._watch.busy

    def healthy(self) -> bool:
        """Whether it can still take a call now; what feeds hardware watchdogs asks this."""
        return not self._closed and self._dispatcher.draining

    def _check_open(self) -> None:
        _process.refuse_after_fork()
        if self._closed:
            raise container_closed(self.address)

    def close(self) -> None:
        """Leave: services, handles and notifications end; nothing stays behind. Idempotent."""
        if _process.forked():
            return
        with self._closing:  # who comes second waits until it is done
            if self._closed:
                return
            self.locking.keeper.close()  # gives back what it holds, while it can still be heard
            self._closed = True
            self._targets.clear()
            self._leaving.close()

    def abandon(self) -> None:
        """In a forked child: everything belongs to the parent; touch nothing, refuse everything."""
        self._closed = True
        self._targets.clear()
        self._leaving.pop_all()

    def __enter__(self) -> "Container":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<Container {self.address} of {self._settings.system}>"
