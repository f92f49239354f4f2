"""One participant: starts, joins, hosts providers, looks up, leaves. Ties the other modules together."""

import asyncio
import atexit
import contextlib
import os
import secrets
import threading
import weakref
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final

import msgspec
from msgspec import structs

from trade import _many
from trade._announcing import Announcer
from trade._calls import Caller
from trade._codec import Codec
from trade._constraints import Constraint, checked_meta, where
from trade._context import handed_down
from trade._coroutines import AsyncLoop
from trade._dispatch import Dispatcher
from trade._estop_line import EstopReport
from trade._estopping import LIMIT_S, Estopping
from trade._handle import Bound, Handle, Run
from trade._hints import no_such_service, too_many_services
from trade._inherited import InheritedLock
from trade._invoke import LocalTarget, RemoteTarget, container_closed, new_request
from trade._joining import join
from trade._lock import Lock, OnLost, OnRequest
from trade._locking import LEASE_S, Locking
from trade._locks import LockTable
from trade._notifications import Callback, Notification, Notifier
from trade._own_services import OwnServices
from trade._providers import Providers, checked_groups, checked_health
from trade._reach import Reach
from trade._registry import Change, Record, Registry
from trade._resources import Holder
from trade._settings import Settings
from trade._system import DOMAIN, PROVIDER, ContainerInfo, System
from trade._terms import LockInfo
from trade._transport import ChannelClosed, Transport
from trade._watch import Watch
from trade._wire import (
    HEALTHY,
    Address,
    Estop,
    ProviderInfo,
    Scalar,
    ServiceKey,
    Token,
    alive_key,
    encode_message,
)
from trade._withdrawn import Withdrawn
from trade._zenoh import ZenohTransport
from trade.errors import ConfigurationError, ServiceGone

__all__ = ["Container"]

_HANDLE_EXT: Final = 1
_PATIENCE_S: Final = 1.0
"""How long a call waits for the registry to hear of a handle that came by message before its registry entry did."""

_live: "weakref.WeakSet[Container]" = weakref.WeakSet()


class Container:
    """A participant of a system; most programs use the default one through the functions of ``trade``.

    Joins on construction. A context manager; ``close()`` leaves and is idempotent.

    Raises:
        ConfigurationError: a setting is wrong, the endpoint is taken, or this process was forked from one that has a
            container.
    """

    def __init__(self, settings: Settings | None = None, *, transport: Transport | None = None) -> None:
        _refuse_after_fork()
        _note_start()
        self._settings = settings or Settings.read()
        self.address: Final = Address(self._settings.identity, self._settings.container, secrets.token_hex(6))
        self.session: Final = str(self.address)
        self._closing = threading.RLock()
        self._closed = False
        self.system: Final = System(lambda: self)
        """Its own switches: who it is linked to, and whether it lets itself be found."""
        self._targets: dict[ServiceKey, LocalTarget | RemoteTarget] = {}
        self._codec = Codec(self._handle_to_data, self._data_to_handle, (Handle,))
        self._registry = Registry(self.address)
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
            self._notifier = Notifier(lambda record: Handle(self, record.key, record))
            leaving.callback(self._notifier.close)
            self._inherited = InheritedLock(self._settings.lock, self.address) if self._settings.lock else None
            if self._inherited is not None:
                handed_down[self.address] = self._inherited
                leaving.callback(handed_down.pop, self.address)
            self._registry.listen(self._changed)
            self._registry.listen(self._notifier.changed)
            coroutines = AsyncLoop()
            leaving.callback(coroutines.close)
            self.locking: Final = Locking(self)
            """Its locks on what others offer, and on what it offers itself."""
            self._table = LockTable(self.address.epoch, self.name)
            leaving.callback(self._table.close)
            announcer = Announcer(self._transport, self.address)
            leaving.callback(announcer.close)
            self._providers = Providers(announcer, self._registry, self.address, self._codec, coroutines, self._table)
            state = self._settings.state_dir
            self._estopping = Estopping(
                self._transport,
                self.address,
                self._registry,
                self._table,
                self._providers,
                None if state is None else state / self._settings.system / "estop",
            )
            leaving.callback(self._estopping.close)
            self._deadman = self._estopping.deadman
            self._table.stop_with(self._deadman.stop)
            self.withdrawn: Final = Withdrawn(self._providers)
            """What was taken off from elsewhere and can be offered again."""
            self._dispatcher = Dispatcher(self._transport, self.address, self._providers.lookup, coroutines)
            leaving.callback(self._dispatcher.close)
            own = OwnServices(
                self.system,
                self._table,
                self.address,
                self._ask_for_release,
                self.locking.keeper.asked,
                self._estopping.open_here,
            )
            self._providers.add(own, (DOMAIN,), name=PROVIDER)
            self._estopping.begin(own)
            presence = self._transport.appear(alive_key(self.address))
            leaving.callback(presence.close)
            self._watch = Watch(self._transport, self._registry, self.address, self._lost, announcer.beat)
            leaving.callback(self._watch.close)
            self._leaving = leaving.pop_all()
        _live.add(self)

    # --- hosting

    def register(
        self,
        provider: object,
        groups: str | Sequence[str] = (),
        *,
        implements: Sequence[type] = (),
        meta: Mapping[str, Scalar] | None = None,
    ) -> tuple[Handle, ...]:
        """Offer an object's services to the whole system.

        Args:
            provider: an object whose class, bases or interfaces have ``@service`` methods.
            groups: dotted labels such as ``"rosie.head"``.
            implements: interfaces (protocols) the object fits without inheriting from them.
            meta: numbers, texts, booleans by name; holds for all its services, over what they say themselves.

        Returns:
            Handles of its services.

        Raises:
            ConfigurationError: nothing to offer, a type that cannot be sent, a malformed group, or it is registered
                already.
        """
        self._check_open()
        try:
            keys = self._providers.add(provider, checked_groups(provider, groups), implements, meta=meta)
        except ChannelClosed:  # closed by another thread meanwhile
            raise container_closed(self.address) from None
        self.withdrawn.forget(provider)
        return tuple(self.handle(key) for key in keys)

    def deregister(self, provider: object) -> None:
        """Withdraw an object's services from the whole system; handles of them fail from now on.

        Raises:
            ConfigurationError: it is not registered here.
        """
        self._check_open()
        if not self.withdrawn.forget(provider):
            self._providers.remove(provider)

    def set_groups(self, provider: object, groups: str | Sequence[str]) -> None:
        """Put a live provider into other groups. Handles stay valid: its place was settled when it was registered.

        Raises:
            ConfigurationError: a malformed group, or it is not registered here.
        """
        named = checked_groups(provider, groups)
        self._alter(provider, lambda info: structs.replace(info, groups=named))

    def add_group(self, provider: object, group: str) -> None:
        """Put a live provider into one more group. Raises like `set_groups`."""
        [named] = checked_groups(provider, (group,))
        self._alter(provider, lambda info: structs.replace(info, groups=tuple(dict.fromkeys((*info.groups, named)))))

    def remove_group(self, provider: object, group: str) -> None:
        """Take a live provider out of a group; one it is not in is fine. Raises like `set_groups`."""
        self._alter(
            provider,
            lambda info: structs.replace(info, groups=tuple(known for known in info.groups if known != group)),
        )

    def set_health(self, provider: object, health: str = HEALTHY) -> None:
        """Say what is wrong with a provider, such as ``"degraded: overheating"``, or that nothing is any more.

        Raises:
            ConfigurationError: no text, or it is not registered here.
        """
        said = checked_health(provider, health)
        self._alter(provider, lambda info: structs.replace(info, health=said))

    def alter(self, provider: object, *, meta: Mapping[str, Scalar] | None = None) -> None:
        """Read a live provider again, as if it were registered anew: its class's marks, its resources. Handles hold.

        Args:
            provider: the object.
            meta: instead of the metadata it was registered with; by default that stays.

        Raises:
            ConfigurationError: like `register`, or it is not registered here.
        """
        new = None if meta is None else checked_meta(meta)
        self._alter(provider, lambda info: info if new is None else structs.replace(info, meta=new), reread=True)

    def _alter(self, provider: object, change: Callable[[ProviderInfo], ProviderInfo], *, reread: bool = False) -> None:
        self._check_open()
        try:
            self._providers.alter(provider, change, reread=reread)
        except ChannelClosed:  # closed by another thread meanwhile
            raise container_closed(self.address) from None

    # --- looking up

    def services(self, constraint: Constraint | None = None) -> list[Handle]:
        """Handles of all services that match, ordered by group and name; without a constraint, of everything."""
        self._check_open()
        wanted = where() if constraint is None else constraint
        return [Handle(self, record.key, record) for record in self._registry.select(wanted)]

    def find(self, constraint: Constraint, *, wait_s: float = 2.0) -> Handle:
        """The only service that matches; waits for it to appear.

        Raises:
            NoSuchService: none within ``wait_s`` seconds.
            TooManyServices: more than one.
        """
        self._check_open()
        matches: list[Record] = []

        def found() -> bool:
            matches[:] = self._registry.select(constraint)
            return bool(matches)

        if not self._registry.wait_for(found, wait_s):
            raise no_such_service(constraint, self._registry.select(where()), wait_s)
        if len(matches) > 1:
            raise too_many_services(constraint, matches)
        return Handle(self, matches[0].key, matches[0])

    def addresses(self) -> list[Address]:
        """Where the containers of the system are, this one included."""
        return [state.address for state in self._registry.containers()]

    def containers(self) -> list[ContainerInfo]:
        """The containers of the system, this one included."""
        self._check_open()
        infos: list[ContainerInfo] = []
        for state in self._registry.containers():
            records = [record for _, provided in list(state.providers.values()) for record in provided]
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

    def joined(self, constraint: Constraint, call: Callback, *, existing: bool = False) -> Notification:
        """Call with the handle of every service that comes and matches.

        Args:
            constraint: which services.
            call: a handle, or a function of this process.
            existing: also once for each that is there already.
        """
        return self._notify("joined", constraint, call, existing=existing)

    def left(self, constraint: Constraint, call: Callback) -> Notification:
        """Call with the (dead) handle of every service that goes and matched."""
        return self._notify("left", constraint, call, existing=False)

    def changed(self, constraint: Constraint, call: Callback) -> Notification:
        """Call with the handle of every service whose groups, metadata, health or description become others.

        It fires for what matches, and once more for what has just ceased to. Who is quick may find several changes in
        one.
        """
        return self._notify("changed", constraint, call, existing=False)

    def _notify(self, occasion: str, constraint: Constraint, call: Callback, *, existing: bool) -> Notification:
        self._check_open()
        if not callable(call):
            raise ConfigurationError(
                where=f"trade.{occasion}", problem=f"call must be a handle or a function, not {call!r}"
            )
        notification = Notification(occasion, constraint, call)
        self._registry.between_changes(
            lambda: self._notifier.add(notification, self._registry.select(constraint) if existing else [])
        )
        return notification

    def _lost(self, address: Address, *, back: bool = False) -> None:
        """Told by the watch: a container is out of sight, or there again."""
        self._caller.lost(address, back=back)
        if not back:
            self.locking.keeper.lost(address)
            if self._inherited is not None:
                self._inherited.lost(address)
            self._table.session_ended(str(address), f"its owner {address.container} has ended or cannot be reached")
            self._deadman.session_ended(str(address))

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
        request = new_request(deadline_s)
        target = self._targets.get(handle.key)
        return (target or self._new_target(handle)).invoke(args, kwargs, request)

    def begin(self, handle: Handle, args: tuple[Any, ...], kwargs: dict[str, Any], deadline_s: float | None) -> Run:
        """Call a service without waiting; what ``handle.start(...)`` does."""
        request, run = new_request(deadline_s), Run(handle)
        self._target(handle).begin(args, kwargs, request, run)
        return run

    def call(self, constraint: Constraint, /, *args: Any, **kwargs: Any) -> Any:
        """Call the only service that matches. Raises what `find` raises, and what the call does."""
        return self.find(constraint)(*args, **kwargs)

    def call_all(
        self, which: Constraint | Iterable[Handle | Bound], /, *args: Any, **kwargs: Any
    ) -> list[_many.Outcome]:
        """Call several services at once and wait for all of them.

        Args:
            which: a constraint (all that match now), or handles; bound calls bring arguments of their own.
            args: for each.
            kwargs: for each.

        Returns:
            An outcome for each, in order; what one raises is its own outcome and stops no other.
        """
        return _many.all_outcomes(self._bound(which, args, kwargs))

    def call_sequence(self, calls: Iterable[Handle | Bound], /, *, go_on: bool = False) -> list[_many.Outcome]:
        """Make calls one after the other.

        Args:
            calls: bound calls, or handles of services without arguments.
            go_on: also after an error, at which it stops otherwise.

        Returns:
            Outcomes of those that ran.
        """
        return _many.sequence(self._bound(calls, (), {}), go_on=go_on)

    async def acall(self, constraint: Constraint, /, *args: Any, **kwargs: Any) -> Any:
        """`call` from asyncio."""
        handle = await asyncio.to_thread(self.find, constraint)
        return await handle.acall(*args, **kwargs)

    async def acall_all(
        self, which: Constraint | Iterable[Handle | Bound], /, *args: Any, **kwargs: Any
    ) -> list[_many.Outcome]:
        """`call_all` from asyncio."""
        return await _many.all_outcomes_async(self._bound(which, args, kwargs))

    async def acall_sequence(self, calls: Iterable[Handle | Bound], /, *, go_on: bool = False) -> list[_many.Outcome]:
        """`call_sequence` from asyncio."""
        return await _many.sequence_async(self._bound(calls, (), {}), go_on=go_on)

    def _bound(
        self, which: Constraint | Iterable[Handle | Bound], args: tuple[Any, ...], kwargs: dict[str, Any]
    ) -> list[Bound]:
        self._check_open()
        return _many.bound(self.services(which) if isinstance(which, Constraint) else which, args, kwargs)

    def _target(self, handle: Handle) -> LocalTarget | RemoteTarget:
        target = self._targets.get(handle.key)
        return target if target is not None else self._new_target(handle)

    def _new_target(self, handle: Handle) -> LocalTarget | RemoteTarget:
        self._check_open()
        key = handle.key
        known = self._registry.get(key) is not None or handle.last_record is not None or self._registry.removed(key)
        if not known:
            self._registry.wait_for(lambda: self._registry.get(key) is not None, _PATIENCE_S)
        record = self._registry.get(key)
        target = None if record is None else self._make_target(record)
        if target is None:
            raise self._gone(handle)
        self._targets[key] = target
        if self._closed or self._registry.get(key) is not record:  # it left, or is another one, since we looked
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
        if self._registry.is_alive(address):
            reason = "its provider was deregistered" if self._registry.removed(handle.key) else "it is not known here"
        else:
            reason = f"container {address.container} has ended, restarted or cannot be reached"
        return ServiceGone(service=handle.label, reason=reason)

    def _handle_to_data(self, value: Any) -> Any:
        if isinstance(value, Handle):
            return msgspec.msgpack.Ext(_HANDLE_EXT, encode_message(value.key))
        raise TypeError(f"a {type(value).__qualname__} is no plain data")

    def _data_to_handle(self, code: int, data: memoryview) -> Any:
        if code != _HANDLE_EXT:
            raise msgspec.ValidationError(f"Unknown extension {code}")
        return self.handle(msgspec.msgpack.decode(data, type=ServiceKey))

    # --- locks

    def lock(
        self,
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
        """Services for oneself alone, on all their containers or on none: ``with container.lock(...):``.

        Nothing is taken before the context is entered (or `Lock.acquire` called).

        Args:
            which: the actuating services that match, as they are now, or handles.
            purpose: what for, as others are told who would like to have them.
            wait_s: how long to wait for others, in seconds; 0 tries.
            lease_s: how long it outlives its owner, in seconds.
            priority: who waits with a higher one comes first.
            delegates: identities that may use it, too.
            partial: take a robot's group even if members of it are not there.
            on_lost: called with the error, on a thread of its own, when it is lost.
            on_request: called with who and why, on a thread of its own, when somebody asks for it.

        Raises:
            LockedByOther: somebody has one of them, or something still moves, after ``wait_s``.
            IncompleteGroup: the robot file says that more belongs to the group.
            ConfigurationError: nothing to lock.
            DeviceSilent: one of them could not be stopped when it had to be.
        """
        self._check_open()
        return self.locking.lock(
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

    def locks(self) -> list[LockInfo]:
        """Every lock in the system: what, whose, what for, since when, who waits."""
        self._check_open()
        return self.locking.locks()

    def request_release(self, which: Constraint | Iterable[Handle], reason: str) -> list[str]:
        """Ask the owners of locks on these services to give them back; they hear of who asks, and why.

        Returns:
            Who was asked.
        """
        self._check_open()
        return self.locking.request_release(which, reason)

    def break_lock(self, which: Constraint | Iterable[Handle], reason: str) -> list[LockInfo]:
        """Take the locks on these services away from their owners; what moves under them stops.

        Returns:
            Those that were broken.
        """
        self._check_open()
        return self.locking.break_lock(which, reason)

    def resume(self, which: Constraint | Iterable[Handle]) -> list[str]:
        """Let services move again after a stop by somebody else.

        Returns:
            The resources that were stopped.

        Raises:
            LockedByOther: it is the owner of their lock who resumes.
        """
        self._check_open()
        return self.locking.resume(which)

    # --- e-stops

    def estop(self, reason: str = "", *, limit_s: float = LIMIT_S) -> EstopReport:
        """Stop everything in the whole system, and let nothing move until the e-stop is cleared (S09).

        It waits for nobody to be told, and is repeated until every container that has a stop service has confirmed
        that all of it is at rest. Read the report: `EstopReport.complete`. This is software, not safety-rated.

        Args:
            reason: why, for people.
            limit_s: how long to try, in seconds; also if nobody is found.
        """
        self._check_open()
        return self._estopping.estop(reason, limit_s)

    def estops(self) -> list[Estop]:
        """The e-stops that are open anywhere in the system, oldest first."""
        self._check_open()
        return self._estopping.open()

    def estop_clear(self, ids: Sequence[str], *, limit_s: float = LIMIT_S) -> EstopReport:
        """Clear e-stops by their ids; once none is open, calls are let through again. Nothing moves by itself.

        What somebody else's e-stop stopped while it was in use holds until `resume`, too (S08). A container that does
        not hear this, being away, keeps them open until they are cleared again.

        Args:
            ids: as `estops` tells them.
            limit_s: how long to try, in seconds.

        Raises:
            NoSuchEstop: an id that nobody knows as open; nothing is cleared then.
        """
        self._check_open()
        return self._estopping.clear(ids, limit_s)

    # --- being

    @property
    def name(self) -> str:
        """The container's name."""
        return self.address.container

    @property
    def settings(self) -> Settings:
        """What it was started with."""
        return self._settings

    @property
    def dropped_messages(self) -> int:
        """Messages that were malformed or of another protocol version."""
        return self._dispatcher.malformed + self._caller.malformed + self._watch.malformed + self._estopping.malformed

    @property
    def catching_up(self) -> bool:
        """Whether it is asking others for what it may have missed."""
        return self._watch.busy

    def healthy(self) -> bool:
        """Whether it can still take a call now; what feeds hardware watchdogs asks this."""
        return not self._closed and self._dispatcher.draining

    def _check_open(self) -> None:
        _refuse_after_fork()
        if self._closed:
            raise container_closed(self.address)

    def close(self) -> None:
        """Leave: services, handles and notifications end; nothing stays behind. Idempotent."""
        if _forked:
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


@atexit.register
def _close_all() -> None:
    """The interpreter must not end under threads that wait inside the transport."""
    for container in list(_live):
        container.close()


_started = False
_forked = False


def _note_start() -> None:
    global _started  # noqa: PLW0603 - a fact about the process: the transport's runtime stays for good
    _started = True


def _after_fork() -> None:
    global _forked  # noqa: PLW0603 - a fact about the process
    _forked = _forked or _started
    for container in list(_live):
        container.abandon()
    _live.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def _refuse_after_fork() -> None:
    if _forked:
        problem = (
            "this process was forked from one that had a container, which cannot work; start it with spawn, not fork"
        )
        raise ConfigurationError(problem=problem)
