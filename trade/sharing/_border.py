"""Federates two systems: offers services of each in the other, through a container in each of them."""

import contextlib
import logging
import threading
from collections.abc import Generator, Sequence
from contextlib import ExitStack
from functools import partial
from typing import Any, Final
from weakref import WeakValueDictionary

import msgspec
from msgspec import structs

from trade._calls.handle import Handle, handle_codec
from trade._container.container import Container
from trade._context.call_context import CallContext, running
from trade._context.outgoing import Claim, holding
from trade._context.sessions import speaking
from trade._estop.deadman import NO_CLIENT
from trade._federation.federation import MemberSystem, ProviderPlace, inside, shown
from trade._locks.api import LEASE_S
from trade._locks.lock import Lock, OnLost, OnRequest, Selection
from trade._locks.remote_locks import SharedResource, Wanted
from trade._registry.registry import Change
from trade._resources.grants import LockRequest
from trade.errors import ConfigurationError, TradeError
from trade.protocol.keys import DOMAIN, PROVIDER, Address, ServiceKey
from trade.protocol.messages import Behalf, Estop, ProviderInfo
from trade.sharing._guest_sessions import GuestSessions
from trade.transport.base import ChannelClosed

_logger = logging.getLogger("trade")

_PARTING_S: Final = 5.0
SHARED_FROM: Final = "shared_from"
"""Metadata of a provider of another system: the name of its system. Such a provider is not shared any further."""


class Border:
    """Federates two systems that share some services; each container acts in its system for the other's clients.

    A context manager; `close` withdraws everything. The containers stay open; their creators close them.

    Args:
        own: a container of one system.
        other: a container of another one.
        exported: groups of our system that the other one sees and calls; ``*`` is all.
        imported: groups of the other system that ``own`` sees and calls.

    Raises:
        ConfigurationError: both containers belong to one system.
    """

    def __init__(
        self, own: Container, other: Container, *, exported: Sequence[str] = (), imported: Sequence[str] = ()
    ) -> None:
        names = [one.settings.system for one in (own, other)]
        if names[0] == names[1]:
            problem = "a system cannot be shared with itself; name another one"
            raise ConfigurationError(where=f"share with {names[0]}", problem=problem)
        with ExitStack() as leaving:
            self.out = BorderDirection(own, other, exported)
            leaving.callback(self.out.close)
            self.back = BorderDirection(other, own, imported)
            leaving.callback(self.back.close)
            self.out.reverse, self.back.reverse = self.back, self.out
            self.out.begin()
            self.back.begin()
            self._leaving = leaving.pop_all()

    def share(self, *, exported: Sequence[str], imported: Sequence[str]) -> None:
        """Replace the lists of groups; services that stay shared are not affected."""
        self.out.share(exported)
        self.back.share(imported)

    def close(self) -> None:
        """Withdraw everything, and stop the motion that clients of the other side started. Idempotent."""
        self._leaving.close()

    def __enter__(self) -> "Border":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class BorderDirection:
    """The services of one system (home) that are offered in the other one (remote)."""

    reverse: "BorderDirection"

    def __init__(self, home: Container, remote: Container, groups: Sequence[str]) -> None:
        self._home = home
        self._remote = remote
        self._groups = tuple(groups)
        self._names = home.settings.system, remote.settings.system
        self._guests = GuestSessions(remote.federation, home, self._names[1])
        self._offered: dict[ProviderPlace, _OfferedProvider] = {}
        self._origins: dict[ProviderPlace, ProviderPlace] = {}
        """From places in the remote system to places at home."""
        self._resources: WeakValueDictionary[tuple[Address, str], SharedResource] = WeakValueDictionary()
        self._refused: dict[ProviderPlace, str] = {}
        self._codec = handle_codec(self._handle_out, self._handle_in)
        self._changed = threading.Event()
        self._leaving = ExitStack()
        self._closed = False
        self._thread = threading.Thread(target=self._keep, name=f"trade-share-{self._names[1]}", daemon=True)

    def begin(self) -> None:
        """Offer current and future services. Returns when the current ones are offered."""
        self._leaving.callback(self._remote.session_end.subscribe(self._guests.ended))
        self._leaving.callback(self._guests.close)
        self._leaving.callback(self._withdraw_all)
        self._leaving.callback(self._home.registry.changes.subscribe(self._note))
        self._reconcile()
        self._thread.start()
        self._leaving.callback(self._end_thread)
        self._home.federation.estop.subscribe(self._estop)
        self._leaving.callback(self._home.federation.estop.unsubscribe, self._estop)

    def share(self, groups: Sequence[str]) -> None:
        """Replace the list of groups."""
        self._groups = tuple(groups)
        self._changed.set()

    # --- what is offered

    def _note(self, _: Change) -> None:
        self._changed.set()

    def _keep(self) -> None:
        while True:
            self._changed.wait()
            self._changed.clear()
            if self._closed:
                return
            try:
                self._reconcile()
            except Exception:
                _logger.exception("what %s shares with %s could not be brought up to date", *self._names)

    def _reconcile(self) -> None:
        """Make the services offered remotely equal to those at home that are in the list."""
        there = {
            place: self._described(info)
            for place, info in self._home.federation.offers().items()
            if self._is_shared(place, info)
        }
        for place, offered in self._offered.copy().items():
            if place not in there or there[place].services != offered.info.services:
                self._withdraw(place, offered)
        for place, info in there.items():
            known = self._offered.get(place)
            try:
                if known is None:
                    self._offer(place, info)
                elif structs.replace(info, revision=known.info.revision) != known.info:
                    self._remote.federation.update(known.provider, info)
                    known.info = info
            except TradeError as refused:
                self._complain(place, str(refused))
        self._refused = {place: why for place, why in self._refused.items() if place in there}

    def _is_shared(self, place: ProviderPlace, info: ProviderInfo) -> bool:
        return SHARED_FROM not in info.meta and inside(place.domain, self._groups)

    def _described(self, info: ProviderInfo) -> ProviderInfo:
        """The description of a provider for the other system: without anything that is not shared."""
        members = {group: names for group, names in info.members.items() if inside(group, self._groups)}
        meta = {**info.meta, SHARED_FROM: self._names[0]}
        groups = shown(info, self._groups)
        return structs.replace(info, groups=groups, members=members, meta=meta, estops=())

    def _offer(self, place: ProviderPlace, info: ProviderInfo) -> None:
        home = MemberSystem(
            place, self._home.handle, partial(self._speaking, what=place), self._codec, self._adopt(place)
        )
        offered = _OfferedProvider(info)
        offered.place = self._remote.federation.pass_on(offered.provider, info, home)
        self._origins[offered.place] = place
        self._offered[place] = offered
        self._refused.pop(place, None)

    def _adopt(self, place: ProviderPlace) -> Any:
        def adopt(here: str, there: str) -> SharedResource:
            key = place.address, here
            found = self._resources.get(key)
            if found is None:
                found = self._resources[key] = SharedResource(here, place.address, there, self)
            return found

        return adopt

    def _withdraw(self, place: ProviderPlace, offered: "_OfferedProvider") -> None:
        """Stop the motion of the other system's clients first: afterwards they could not stop it."""
        del self._offered[place]
        with contextlib.suppress(ConfigurationError, ChannelClosed):  # it was done before, or everything is gone
            self._remote.federation.withdraw(offered.provider)
        self._guests.leave(place)
        self._origins.pop(offered.place, None)

    def _complain(self, place: ProviderPlace, reason: str) -> None:
        if self._refused.get(place) != reason:
            self._refused[place] = reason
            _logger.error("%s of %s is not shared with %s: %s", place.provider, *self._names, reason)

    # --- handles

    def _handle_out(self, handle: Handle) -> ServiceKey:
        """The key of a home service's handle in the remote system."""
        key = self._remote_of(handle.key) or self.reverse.home_of(handle.key)
        if key is None:
            raise TypeError(f"{handle.label} is not shared with system {self._names[1]}")
        return key

    def _handle_in(self, given: ServiceKey) -> Handle:
        """The home handle of a service key from the remote system."""
        key = self.home_of(given) or self.reverse._remote_of(given)
        if key is None:
            raise msgspec.ValidationError(f"{given.domain}.{given.name} is not shared with system {self._names[0]}")
        return self._home.handle(key)

    def _remote_of(self, key: ServiceKey) -> ServiceKey | None:
        offered = self._offered.get(ProviderPlace(key.address, key.domain, key.provider))
        return None if offered is None else offered.place.service(key.name)

    def home_of(self, key: ServiceKey) -> ServiceKey | None:
        """The home service of a service offered in the remote system."""
        place = self._origins.get(ProviderPlace(key.address, key.domain, key.provider))
        return None if place is None else place.service(key.name)

    # --- calls and locks from the remote system, continued at home

    @contextlib.contextmanager
    def _speaking(self, call: CallContext, what: ProviderPlace | None) -> Generator[None]:
        """Makes home calls on behalf of a remote call, under the locks that it carries."""
        if call.session == NO_CLIENT:  # the deadman of our own container: the stop is ours
            sessions, names = [], [str(self._home.address)]
        else:
            sessions = self._guests.of(call, what)
            names = [session.name for session in sessions]
        calls = () if call.behalf is None else call.behalf.calls
        behalf = Behalf(tuple(names[1:]), calls, ())
        there = structs.replace(call, session=names[0], behalf=behalf, ongoing=None, permit=None)
        locks = self._remote.federation.remote_locks.of_call(call)
        with ExitStack() as after:
            after.callback(running.reset, running.set(there))
            after.callback(holding.reset, holding.set(locks))
            after.callback(speaking.reset, speaking.set(sessions[0] if sessions else None))
            yield

    def lock(
        self, call: CallContext, wanted: Wanted, terms: LockRequest, on_lost: OnLost, on_request: OnRequest
    ) -> Lock:
        """Lock home resources for a remote client; renewed for as long as the client renews its lock there."""
        request = LockRequest(purpose=terms.purpose, lease_s=LEASE_S, wait_s=terms.wait_s)
        asked = {address: list(names) for address, names in wanted.items()}
        with self._speaking(call, None):
            return Lock(
                self._home.federation.lease_client,
                request,
                lambda: Selection(asked),
                on_lost,
                on_request,
                Claim(),
            ).acquire()

    def resume(self, call: CallContext, address: Address, names: Sequence[str]) -> list[str]:
        """Resume resources at home if the client of the other system may do so; returns those that were stopped."""
        with self._speaking(call, None):
            return self._function(address, "resume")(list(names))

    def request_release(self, call: CallContext, address: Address, names: Sequence[str], reason: str) -> list[str]:
        """Ask the owners at home to release resources; returns the owners asked."""
        with self._speaking(call, None):
            return self._function(address, "request_release")(list(names), reason)

    def _function(self, address: Address, name: str) -> Handle:
        return self._home.handle(ServiceKey(address, DOMAIN, PROVIDER, name))

    # --- e-stops

    def _estop(self, estop: Estop) -> str:
        """Called by home: an e-stop applies on both sides, and is cleared on each. Returns what has not confirmed."""
        try:
            problem = self._remote.federation.estop.carry(estop, self._names[0])
        except ChannelClosed:
            problem = "the gateway has no link there"
        return f"in system {self._names[1]}: {problem}" if problem else ""

    def _end_thread(self) -> None:
        self._closed = True
        self._changed.set()
        self._thread.join(_PARTING_S)

    def _withdraw_all(self) -> None:
        for place, offered in self._offered.copy().items():
            self._withdraw(place, offered)

    def close(self) -> None:
        """Withdraw everything. Idempotent."""
        self._leaving.close()


class _OfferedProvider:
    """One provider, as it is offered in the other system."""

    place: ProviderPlace

    def __init__(self, info: ProviderInfo) -> None:
        self.info = info
        self.provider: Final = object()
        """Its proxy there."""
