"""The operations of clients, for every protocol: authorised in their name, run in their session, in threads."""

import logging
from collections.abc import Awaitable, Callable, Sequence
from functools import partial
from math import inf
from typing import Any, Final, TypeVar

import anyio
from anyio.to_thread import run_sync

from trade import (
    Constraint,
    Container,
    EstopReport,
    Handle,
    Lock,
    Notification,
    Reachability,
    Run,
    where,
)
from trade import Stream as Samples
from trade.errors import (
    AccessDenied,
    Cancelled,
    ConfigurationError,
    InvalidArgument,
    LockLost,
    NoSuchService,
    TooManyServices,
    TradeError,
)
from trade_gateway.clients import _schemas as messages
from trade_gateway.clients._administration import Administration
from trade_gateway.clients._authorizer import ClientAuthorizer
from trade_gateway.clients._clients import MOST_CALLS, Client, Clients, Quota, places
from trade_gateway.clients._configuration import Configuration
from trade_gateway.clients._notification_forwarder import NotificationForwarder
from trade_gateway.clients._system_info import Overview

_logger = logging.getLogger("trade")

T = TypeVar("T")

_THREADS: Final = MOST_CALLS + 16
"""Enough for all pending calls, locks and queries, and some for sessions that come and go."""
_ANSWERED_S: Final = 1.0
"""How long to wait for an answer of every container, in seconds."""
_NO_GROUP: Final = "_"
_NOT_RECEIVED: Final = "no container is known to have received it; use the switch that cuts the power"

Gone = Callable[[], Awaitable[object]]
"""Returns when the client that made the request is gone."""


class ClientApi:
    """The operations of clients on a container's system."""

    def __init__(self, container: Container) -> None:
        self._container = container
        self.judge: Final = ClientAuthorizer(container)
        self.clients: Final = Clients(container)
        self._threads = anyio.CapacityLimiter(_THREADS)
        self._stop_threads = anyio.CapacityLimiter(inf)
        self._quota = Quota()
        self.overview: Final = Overview(container, self.judge, self.counted)
        self.administration: Final = Administration(container, self.judge, self.counted)
        self.configuration: Final = Configuration(container, self.judge, self.counted, self.administration)

    async def in_thread(self, do: Callable[..., T], *args: Any, stops: bool = False) -> T:
        """Runs a function that may block in a thread; one that stops something never waits for a free thread."""
        return await run_sync(partial(do, *args), limiter=self._stop_threads if stops else self._threads)

    async def counted(self, identity: str, do: Callable[..., T], *args: Any) -> T:
        """Runs a function as `in_thread` does, counted against the limits of pending operations. Raises TooMany."""
        ended = self._quota.take(identity)
        try:
            return await self.in_thread(do, *args)
        finally:
            ended()

    # --- queries

    def seen(
        self,
        identity: str,
        group: str | None = None,
        name: str | None = None,
        needs: str | None = None,
        achieves: str | None = None,
    ) -> list[Handle]:
        """The services that an identity may know of; an invalid group, name or condition matches none."""
        try:
            conditions = where(needs=needs or None, achieves=achieves or None)
            found = self._container.services(_wanted(group, name) & conditions)
        except ConfigurationError:  # not the name of a group, or no predicate
            return []
        return [handle for handle in found if self.judge.sees(identity, handle)]

    def find(self, identity: str, group: str, name: str, container: str = "") -> Handle:
        """Finds a service by group and name; one of exactly this group has priority over those beneath it.

        Raises:
            NoSuchService, TooManyServices: none, or several, of the services that the client may see match.
        """
        inside = self.seen(identity, None if group == _NO_GROUP else group)
        found = [one for one in inside if one.name == name and container in ("", one.container)]
        exact = [one for one in found if one.key.domain == group or group in one.groups]
        found = exact or (found if group != _NO_GROUP else [])
        if not found:
            raise NoSuchService(constraint=f"{group}.{name}", groups=_groups(self.seen(identity)))
        if len(found) > 1:
            matches = [f"{one.label} in {one.container}" for one in found]
            raise TooManyServices(constraint=f"{group}.{name}", matches=matches, differ=("group", "container"))
        return found[0]

    # --- calls

    async def begin(self, client: Client, handle: Handle, body: messages.CallBody, admitted: int) -> Run:
        """Starts a call without waiting for its end.

        Args:
            client: the caller.
            handle: the service.
            body: its arguments.
            admitted: what `Client.admit` returned for this request.

        Raises:
            TradeError: it is not allowed, or could not begin; Cancelled: the client has requested a stop since.
        """
        self.judge.require_call(client.identity, handle)
        stops = handle.effect == "stop"
        counted = None if stops else self._quota.take(client.identity)
        try:
            run = await self.in_thread(self._begin, client, handle, body, admitted, stops=stops)
        except BaseException:
            if counted is not None:
                counted()
            raise
        if counted is not None:
            run.add_done_callback(lambda _: counted())
        return run

    def _begin(self, client: Client, handle: Handle, body: messages.CallBody, admitted: int) -> Run:
        try:
            given: Any = messages.numbers(body.args)
        except ValueError as bad:
            raise InvalidArgument(
                service=handle.label, argument="args", problem=f"is {bad}", signature=handle.signature
            ) from None
        args: tuple[Any, ...] = tuple(given) if isinstance(body.args, list) else ()
        kwargs: dict[str, Any] = given if isinstance(body.args, dict) else {}
        begin = partial(self._container.client.begin, handle, args, kwargs, body.deadline_s)
        with client.speaking():
            if handle.effect == "stop":
                client.stopping(admitted, handle, begin)
            elif handle.effect == "actuate" and client.overtaken(admitted):
                raise Cancelled(service=handle.label)
            run = begin()
            if handle.effect == "actuate":
                client.stop_again(admitted)
        client.note(run)
        return run

    async def end(self, client: Client, run: Run) -> None:
        """Cancels a call in its client's name."""
        try:
            await self.in_thread(client.cancel, run, stops=True)
        except TradeError as error:  # the call itself reports how it ended
            _logger.info("a call of %s could not be cancelled: %s", client.identity, error)

    async def call(self, client: Client, handle: Handle, body: messages.CallBody, gone: Gone, *, alone: bool) -> Run:
        """Makes a call and waits for its end; cancels it when the client is gone.

        Args:
            client: the caller.
            handle: the service.
            body: its arguments.
            gone: returns when the client no longer waits.
            alone: whether the client exists for this call only, and ends with it.

        Returns:
            The call, which has ended, with or without success.

        Raises:
            TradeError: it could not begin.
            Cancelled: the client no longer waits.
        """
        self.judge.require_unmarked(client.identity, handle)
        run = await self.begin(client, handle, body, client.admit(handle))

        async def watch() -> None:
            await gone()
            if alone:
                await self.in_thread(client.close, stops=True)
            else:
                await self.end(client, run)
            tasks.cancel_scope.cancel()

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(watch)
            await run.settled()
            tasks.cancel_scope.cancel()
        if not run.done():
            raise Cancelled(service=handle.label)
        return run

    # --- locks and stops

    async def lock(
        self, client: Client, body: messages.LockBody, on_lost: Callable[[str, LockLost], object]
    ) -> messages.LockTaken:
        """Takes a lock for a client.

        Raises:
            TradeError: see `trade.Container.lock`; and TooMany. It does not wait for services that do not exist.
        """
        client.locking()
        return await self.counted(client.identity, self._lock, client, body, on_lost)

    def _lock(
        self, client: Client, body: messages.LockBody, on_lost: Callable[[str, LockLost], object]
    ) -> messages.LockTaken:
        wanted = where(group=body.group)
        if not self._container.services(wanted):
            raise NoSuchService(constraint=body.group, groups=_groups(self.seen(client.identity)))
        handles = self._lockable(client, wanted)
        taken: list[Lock] = []

        def lost(error: LockLost) -> None:
            on_lost(client.name_of(taken[0]), error)

        with client.session.use():
            lock = self._container.lock(
                wanted,
                purpose=body.purpose or f"of {client.identity}",
                wait_s=body.wait_s,
                partial=body.partial,
                on_lost=lost,
            )
            taken.append(lock)
            lock.acquire()
        try:
            self._lockable(client, wanted)  # with services that joined meanwhile
        except TradeError:
            lock.release()
            raise
        return messages.LockTaken(client.keep(lock, handles), lock.resources, lock.missing)

    def _lockable(self, client: Client, wanted: Constraint) -> list[Handle]:
        """The services that a lock takes. Raises AccessDenied: the client may not lock all of them."""
        handles = [one for one in self._container.services(wanted) if one.effect == "actuate"]
        self.judge.require(client.identity, "lock", handles)
        return handles

    async def locks(self, identity: str) -> list[messages.LockView]:
        """The locks on services that an identity may know of."""
        known = {name for _, name in places(self.seen(identity))}
        found = await self.counted(identity, self._container.locks)
        return [messages.lock_view(info) for info in found if not known.isdisjoint(info.resources)]

    async def request_release(self, identity: str, body: messages.RequestBody) -> list[str]:
        """Asks the owners of locks to release them; returns the owners. Raises NoSuchService."""
        handles, reason = (
            self._using(identity, body.resources),
            f"{identity}: {body.reason}" if body.reason else f"by {identity}",
        )
        return await self.counted(identity, self._container.request_release, handles, reason)

    async def break_locks(self, identity: str, body: messages.RequestBody) -> list[messages.LockView]:
        """Breaks locks of other owners; motion under them stops. Raises AccessDenied, NoSuchService."""
        handles, reason = (
            self._using(identity, body.resources),
            f"{identity}: {body.reason}" if body.reason else f"by {identity}",
        )
        self.judge.require(identity, "administer", handles)
        broken = await self.counted(identity, self._container.break_lock, handles, reason)
        return [messages.lock_view(info) for info in broken]

    def _using(self, identity: str, resources: Sequence[str]) -> list[Handle]:
        """The services that use exactly these resources. Raises NoSuchService: the client may see no such service."""
        wanted = set(resources)
        actuating = [one for one in self.seen(identity) if one.effect == "actuate"]
        found = [one for one in actuating if wanted.issuperset(name for _, name in places([one]))]
        if not found:
            raise NoSuchService(constraint=", ".join(resources), groups=_groups(self.seen(identity)))
        return found

    async def resume(self, client: Client, body: messages.GroupBody) -> list[str]:
        """Lets services move again; without a lock this needs the right to administer them. Raises AccessDenied."""
        handles = [one for one in self.seen(client.identity, body.group) if one.effect == "actuate"]
        if not handles:
            raise NoSuchService(constraint=body.group, groups=_groups(self.seen(client.identity)))
        others = [one for one in handles if not client.has_locked(one)]
        self.judge.require(client.identity, "administer", others)

        def resume() -> list[str]:
            with client.speaking():
                return self._container.resume(handles)

        return await self.counted(client.identity, resume)

    async def estop(self, identity: str, body: messages.EstopBody) -> messages.Stopped:
        """Stops everything in the system.

        Raises:
            NoContainerFound: no container is known to have received it. It is open here; joining containers receive it.
        """
        reason = f"{identity}: {body.reason}" if body.reason else f"by {identity}"
        report = await self.in_thread(self._container.estop, reason, stops=True)
        look = partial(self._container.reachability, limit_s=0)
        reachability = await self.in_thread(look, stops=True)  # only after the e-stop, as it waits
        if not (report.confirmed or report.missing or report.failed):
            raise reachability.as_error(self._container.settings.system, f"e-stop {report.id}: {_NOT_RECEIVED}")
        return _stopped(report, reachability)

    async def clear(self, identity: str, body: messages.ClearBody) -> messages.Stopped:
        """Clears e-stops.

        Raises:
            AccessDenied: the client may not administer the system.
            NoSuchEstop: none of these e-stops is open.
            NoContainerFound: no e-stop is known, and a container does not answer.
        """
        ids = body.ids or [one.id for one in self._container.estops()]
        self.judge.require_system(identity, "administer", f"e-stop {', '.join(ids)}")
        if not ids:
            await self.counted(identity, self._require_answers)
            return messages.Stopped("", True, (), (), {})
        report = await self.counted(identity, self._container.estop_clear, ids)
        self._container.note_request("e-stop clearing", ", ".join(ids), kind="stop", client=identity)
        return _stopped(report)

    def note_refused(self, error: BaseException) -> None:
        """Audits the policy's refusal of a client; a refusal of this container is recorded already."""
        if isinstance(error, AccessDenied) and error.who != self._container.address.identity:
            why, outcome = str(error), type(error).__name__
            self._container.note_request(error.what, kind="refused", client=error.who, outcome=outcome, error=why)

    def _require_answers(self) -> None:
        reachability = self._container.reachability(limit_s=_ANSWERED_S)
        if not reachability.complete:
            raise reachability.as_error(self._container.settings.system, "so an open e-stop may be unknown here")

    def estops(self, identity: str) -> list[messages.EstopView]:
        """The open e-stops. Raises AccessDenied: an identity may do nothing here but stop."""
        self.judge.require_some(identity, "estops")
        return [messages.EstopView(one.id, one.by, one.reason, one.at, one.told_by) for one in self._container.estops()]

    # --- subscriptions

    async def stream(self, client: Client, handle: Handle, request: messages.Stream) -> Samples:
        """Streams samples of a service until the client is gone. Raises like `trade.Container.stream`."""
        self.judge.require_call(client.identity, handle)

        def listen() -> Samples:
            with client.session.use():
                return self._container.stream(handle, hz=request.hz, on_change=request.on_change)

        return await self.counted(client.identity, listen)

    def view(self, identity: str, handle: Handle) -> messages.ServiceView:
        """The description of a service for an identity."""
        return messages.service_view(handle, allowed=self.judge.may_call(identity, handle))

    def watch(
        self, client: Client, request: messages.Watch, callback: Callable[[str, Handle], object]
    ) -> list[Notification]:
        """Notifies a client of services that come, go or change, if it may know of them, until it is gone."""

        wanted, here = _wanted(request.group, request.name), self._container
        with client.session.use():
            kinds = {
                "joined": partial(here.joined, existing=request.existing),
                "left": here.left,
                "changed": here.changed,
            }
            return [
                kinds[one](wanted, NotificationForwarder(client, one, self.judge, callback).hear)
                for one in dict.fromkeys(request.occasions)
            ]


def _wanted(group: str | None, name: str | None) -> Constraint:
    return where(group=group or None, name=name or None)


def _groups(handles: Sequence[Handle]) -> list[str]:
    return sorted({group for handle in handles for group in handle.groups})


def _stopped(report: EstopReport, reachability: Reachability | None = None) -> messages.Stopped:
    apart = reachability.unreached if reachability is not None else {}
    complete = report.complete and not apart
    return messages.Stopped(report.id, complete, report.confirmed, report.missing, report.failed, apart)
