"""The call client of a container: it finds services by constraints, and calls them."""

import asyncio
import weakref
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final, cast

from trade._calls import batch
from trade._calls.everywhere import Everywhere, answers, everywhere
from trade._calls.group_view import GroupView, Members
from trade._calls.handle import BoundCall, Handle, service_of
from trade._calls.picking import Pick, Picker, narrowed, required
from trade._calls.reachability import Reachability, beyond, look_around
from trade._calls.run import Run
from trade._calls.target import container_closed
from trade._calls.target_cache import Target, Targets
from trade._context.call_context import patience_s, running
from trade._context.outgoing import new_request
from trade._discovery.dialer import Dialer
from trade._registry.constraints import Constraint, as_constraint, group_at, service_at, services_at, where
from trade._registry.registry import Change, Record, Registry
from trade._registry.suggestions import asked_for, no_such_service, too_many_services
from trade._security.authorizer import Authorizer, verb_of
from trade._table import Table
from trade._threads import fork_guard
from trade.errors import ConfigurationError
from trade.protocol.keys import Address, ServiceKey

_WAIT_S: Final = 2.0
"""How long a call waits for a service that matches."""
_COLUMNS: Final = {
    "SERVICE": "label",
    "CALLED AS": "signature",
    "EFFECT": "effect",
    "HEALTH": "health",
    "CONTAINER": "container",
    "HOST": "host",
}


class CallClient:
    """Finds and calls services of the whole system for one container. It is the home of the container's handles.

    Args:
        address: the container.
        system: the name of its system.
        registry: the services that it knows.
        dialer: its links; None on a transport without links.
        access: the policy, as it applies there.
    """

    def __init__(
        self, address: Address, system: str, registry: Registry, dialer: Dialer | None, access: Authorizer
    ) -> None:
        self.address: Final = address
        self.registry: Final = registry
        self.dialer: Final = dialer
        self.access: Final = access
        self._system = system
        self._picker = Picker(address, self.handle)
        self._closed = False

    def begin_calls(self, targets: Targets) -> None:
        """Makes calls possible.

        Args:
            targets: where calls of its handles go.
        """
        self._targets = targets
        self._known = targets.known

    @property
    def name(self) -> str:
        """The name of its container."""
        return self.address.container

    @property
    def closed(self) -> bool:
        """Whether its container was closed."""
        return self._closed

    def close(self) -> None:
        """Refuses everything from now on."""
        self._closed = True

    def check_open(self) -> None:
        """Raises ConfigurationError if its container was closed, or this process was forked from the container's."""
        fork_guard.refuse_after_fork()
        if self._closed:
            raise container_closed(self.address)

    # --- handles

    def handle(self, key: ServiceKey) -> Handle:
        """A handle of a service whose key is known."""
        return Handle(self, key, self.registry.get(key))

    def handle_of(self, record: Record) -> Handle:
        """A handle of a service whose registry entry is known."""
        return Handle(self, record.key, record)

    def has(self, key: ServiceKey) -> bool:
        """Whether the registry has the service now."""
        return self.registry.get(key) is not None

    def record(self, handle: Handle) -> Record:
        """The registry entry of a service, or the last known one; raises ServiceGone if it has none."""
        record = self.registry.get(handle.key) or handle.last_record
        if record is None:
            raise self._targets.gone_error(handle)
        return record

    def asked_for(self, handle: Handle) -> tuple[str, tuple[str, ...]]:
        """The right over its group that callers of a service need, and the roles that have it by the policy here."""
        key, policy = handle.key, self.access.policy
        verb = verb_of(key.domain, key.name, handle.record.info.effect)
        return verb, policy.roles_with(verb, key.domain) if policy is not None and verb else ()

    def require_call(self, identity: str, handle: Handle) -> None:
        """Raises AccessDenied if a client for whom this container acts may not call that service."""
        key, record = handle.key, handle.record
        self.access.require_call(identity, key.domain, key.name, record.info.effect, record.label)

    # --- calls of handles

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
        self.check_open()
        return self._targets.look_up(handle)

    # --- looking up

    def services(self, which: Constraint | str | None = None) -> Table[Handle]:
        """Handles of all matching services, ordered by group and name.

        Args:
            which: a constraint, or a group as text; by default all services.
        """
        self.check_open()
        wanted = where() if which is None else as_constraint(which, "trade.services", services_at)
        return Table(map(self.handle_of, self.registry.select(wanted)), _COLUMNS)

    def find(
        self,
        which: Constraint | str | type,
        *,
        group: str | None = None,
        container: str | None = None,
        wait_s: float = 2.0,
        follow: bool = False,
        pick: Pick | None = None,
    ) -> Any:
        """The only service that matches, or the only provider of a class; waits for it to appear.

        ``find("rosie.head.move_to")`` returns a `Handle`. ``find(JointGroup, group="rosie.head")`` returns an object
        whose methods are the provider's services; type checkers know it as a ``JointGroup``.

        Args:
            which: a constraint; a service as text, by its group and name, where a service of exactly that group comes
                before services of groups beneath it; or the class of a provider, or a base or interface of it.
            group: a group that it belongs to.
            container: the name of its container.
            wait_s: how long to wait for it, in seconds.
            follow: for a class: whether its methods are found again after a restart of the container; else they raise
                ServiceGone then.
            pick: for a service: which one to return if several match; see `call`.

        Raises:
            NoSuchService: none within ``wait_s`` seconds.
            TooManyServices: more than one.
        """
        self.check_open()
        if pick is not None:
            return self._picked(which, where(group=group, container=container), pick, "trade.find", wait_s)[0]
        if isinstance(which, type):
            wanted = where(kind=which.__name__, group=group, container=container)
            return self._provider(wanted, group, wait_s=wait_s, follow=follow)
        constraint = as_constraint(which, "trade.find", service_at)
        if group is not None or container is not None:
            constraint &= where(group=group, container=container)
        matches = self._await_matches(constraint, wait_s)
        if len(matches) > 1 and isinstance(which, str):
            exact = [record for record in matches if which.rpartition(".")[0] in record.groups]
            matches = exact if len(exact) == 1 else matches
        if len(matches) > 1:
            raise too_many_services(constraint, matches)
        return self.handle_of(matches[0])

    def robot(self, group: str, kind: type | None = None, *, wait_s: float = 2.0, follow: bool = False) -> GroupView:
        """A robot, or any other group, as an object: ``rosie.head.move_to([0.3, -0.2])``, ``rosie.neck.pan.limits()``.

        Its attributes are the services of the group, as handles, and the groups beneath it. Services that join later
        are attributes, too.

        Args:
            group: a dotted group.
            kind: a class that ``trade stubs`` wrote: type checkers know the result as this class. It changes nothing
                else.
            wait_s: how long to wait for it and for each attribute that does not exist yet, in seconds.
            follow: whether an attribute is found again after a restart of its container; else the service raises
                ServiceGone then. Locks and torque do not survive a restart.

        Raises:
            NoSuchService: no service of that group within ``wait_s`` seconds.
            ConfigurationError: it is no group, or ``kind`` is no class.
        """
        self.check_open()
        if not isinstance(kind, type | None):  # pyright: ignore[reportUnnecessaryIsInstance]
            raise ConfigurationError(where="trade.robot", problem=f"kind must be a class, not {kind!r}")
        beneath = as_constraint(group, "trade.robot", group_at)
        self._await_matches(beneath, wait_s)
        return GroupView(self._members(wait_s, follow=follow), beneath, group, group)

    def _provider(self, wanted: Constraint, group: str | None, *, wait_s: float, follow: bool) -> GroupView:
        """The only provider with services that match, as a group of these."""
        matches = self._await_matches(wanted, wait_s)
        exact = [record for record in matches if group in record.groups]
        records = exact or matches
        first = {(record.key.address, record.key.domain, record.key.provider): record for record in records}
        if len(first) > 1:
            raise too_many_services(wanted, list(first.values()))
        own = records[0].groups[0] if records[0].groups else None
        return GroupView(self._members(wait_s, follow=follow), wanted, own, own or records[0].kind)

    def _await_matches(self, constraint: Constraint, wait_s: float) -> list[Record]:
        """The services that match, at least one. Raises NoSuchService after ``wait_s`` seconds."""
        matches: list[Record] = []

        def found() -> bool:
            matches[:] = self.registry.select(constraint)
            return bool(matches)

        self.await_services(constraint, found, wait_s)
        return matches

    def _members(self, wait_s: float, *, follow: bool) -> Members:
        members = Members(
            self.registry.select,
            self.await_services,
            self.handle_of,
            wait_s=wait_s,
            follow=follow,
        )
        if follow:
            living = weakref.ref(members)

            def changed(change: Change) -> None:
                known = living()
                if known is not None and change.left:
                    known.forget(record.key for record in change.left)

            weakref.finalize(members, self.registry.changes.subscribe(changed)).atexit = False
        return members

    def await_services(self, constraint: Constraint, ready: Callable[[], bool], wait_s: float) -> None:
        """Waits until a condition on the services of a constraint holds.

        Args:
            constraint: what the services match; the error suggests similar ones.
            ready: the condition; checked now and after every change.
            wait_s: how long to wait, in seconds.

        Raises:
            NoSuchService: the condition does not hold within ``wait_s`` seconds.
        """
        wait_s = patience_s(wait_s)
        if self.registry.wait_for(ready, wait_s):
            return
        unreached = self._unanswered(wait_s) if len(self.registry.containers()) == 1 else ()
        hidden = self.access.hidden(self.address.identity, asked_for(constraint, "group"))
        others = self.beyond() if wait_s > 0 else ()
        raise no_such_service(constraint, self.registry.select(where()), wait_s, unreached, hidden, others)

    def _unanswered(self, wait_s: float) -> Sequence[str]:
        """Endpoints without a container; the reasons, at half a second each, only if the caller does not wait."""
        if wait_s > 0 or self.dialer is None:
            return self.reachability(limit_s=0).unanswered
        return tuple(f"{endpoint} ({self.dialer.source})" for endpoint in self.dialer.configured)

    def beyond(self, *, wait_s: float = 0.0) -> list[str]:
        """What others see and this container does not, as sentences; waits that long for links, in seconds."""
        return beyond(self.registry, self.dialer, self.handle, wait_s)

    def reachability(self, *, limit_s: float = 3.0) -> Reachability:
        """The containers that it has found: without them, an empty answer of the system means nothing.

        Returns at once when it is `Reachability.complete`.

        Args:
            limit_s: how long to wait for that, in seconds; also if no container is found. Finding the reason for each
                missing link takes up to 3 s more.
        """
        self.check_open()
        return look_around(self.registry, self.dialer, self.address, self._system, limit_s)

    # --- calling

    def call(self, which: Constraint | str, /, *args: Any, pick: Pick | None = None, **kwargs: Any) -> Any:
        """Calls the only service that matches, or one of them. Raises the errors of `find` and of the call.

        Args:
            which: a constraint, or a service as text.
            args: positional arguments of the service.
            pick: which one of several to call. ``"any"``: a random one. ``"local"``: one of this host, of this
                container first. ``"least_busy"``: one of the container with the least to do, by calls and by busy
                cores. ``"nearest"``: one of this container, else of this host, else of the container that answers
                first. If the service is gone or its container has no room, so that the call never ran, the next one is
                called. No other error is passed over.
            kwargs: arguments of the service by name; one called ``pick`` needs a handle from `find`.
        """
        if pick is None:
            return self.find(which)(*args, **kwargs)
        self.check_open()
        return self._picker.call(self._picked(which, where(), pick, "trade.call", _WAIT_S), args, kwargs)

    def _picked(self, which: object, more: Constraint, pick: object, named: str, wait_s: float) -> list[Handle]:
        """The services that match, the best one first."""
        wanted = narrowed(as_constraint(which, named, service_at) & more, chosen := required(pick, named))
        matches = self._picker.order(self._await_matches(wanted, wait_s), chosen)
        return list(map(self.handle_of, matches))

    def call_all(
        self, which: Constraint | str | Iterable[Handle | BoundCall], /, *args: Any, **kwargs: Any
    ) -> list[batch.Outcome]:
        """Calls several services at once and waits for all of them.

        Args:
            which: a constraint or a text (all that match now), or handles; bound calls have their own arguments.
            args: positional arguments of each call.
            kwargs: arguments of each call by name.

        Returns:
            An outcome for each call, in order; an error is the outcome of its call and stops no other.
        """
        return batch.all_outcomes(self._bound(which, args, kwargs))

    def call_sequence(self, calls: Iterable[Handle | BoundCall], /, *, go_on: bool = False) -> list[batch.Outcome]:
        """Makes calls one after the other.

        Args:
            calls: bound calls, or handles of services without arguments.
            go_on: whether to continue after an error; else it stops there.

        Returns:
            The outcomes of the calls that ran.
        """
        return batch.sequence(self._bound(calls, (), {}), go_on=go_on)

    async def acall(
        self,
        which: Constraint | str | Callable[..., Any],
        /,
        *args: Any,
        pick: Pick | None = None,
        **kwargs: Any,
    ) -> Any:
        """`call` from asyncio. It also takes a service; type checkers know the result of a service that has a class.

        With ``pick``, it waits on a thread, and cancelling it does not cancel the call.
        """
        if pick is not None:
            return await asyncio.to_thread(self.call, cast("Any", which), *args, pick=pick, **kwargs)
        if isinstance(which, Constraint | str):
            handle = await asyncio.to_thread(self.find, which)
        else:
            handle = service_of(which, "trade.acall")
        return await handle.acall(*args, **kwargs)

    async def acall_all(
        self, which: Constraint | str | Iterable[Handle | BoundCall], /, *args: Any, **kwargs: Any
    ) -> list[batch.Outcome]:
        """`call_all` from asyncio."""
        return await batch.all_outcomes_async(self._bound(which, args, kwargs))

    async def acall_sequence(
        self, calls: Iterable[Handle | BoundCall], /, *, go_on: bool = False
    ) -> list[batch.Outcome]:
        """`call_sequence` from asyncio."""
        return await batch.sequence_async(self._bound(calls, (), {}), go_on=go_on)

    def ask_all(self, name: str, *args: Any) -> list[Any]:
        """The results of `asked`."""
        return [outcome.result for outcome in self.call_everywhere(name, *args)]

    def call_everywhere(self, name: str, *args: Any, container: str = "*") -> list[batch.Outcome]:
        """The successful calls of one of the middleware's own services in all containers; see `answers`."""
        present = self.everywhere(name, container=container)
        return answers(name, self.call_all(present.handles, *args), present.silent)

    def everywhere(self, name: str, *, container: str = "*") -> Everywhere:
        """One of the middleware's own services in all present containers."""
        self.check_open()
        return everywhere(self, self.registry, name, container)

    def _bound(
        self, which: Constraint | str | Iterable[Handle | BoundCall], args: tuple[Any, ...], kwargs: dict[str, Any]
    ) -> list[BoundCall]:
        self.check_open()
        return batch.bound(self.services(which) if isinstance(which, Constraint | str) else which, args, kwargs)


def _nothing() -> None:
    pass
