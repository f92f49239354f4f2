"""A border between two systems: what of each is offered in the other, through a container in each of them."""

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
from trade._container.federating import Exposed, MemberSystem, inside, shown
from trade._context.call_context import CallContext, running
from trade._context.outgoing import Claim, holding
from trade._context.sessions import speaking
from trade._estop.deadman import NO_CLIENT
from trade._locks.api import LEASE_S
from trade._locks.lock import Lock, OnLost, OnRequest, Selection
from trade._locks.remote_locks import SharedResource, Wanted
from trade._protocol.keys import DOMAIN, PROVIDER, Address, ServiceKey
from trade._protocol.messages import Behalf, Estop, ProviderInfo
from trade._registry.registry import Change
from trade._resources.grants import LockRequest
from trade._transport.base import ChannelClosed
from trade.errors import ConfigurationError, TradeError
from trade.sharing._guest_sessions import GuestSessions

__all__ = ["SHARED_FROM", "Border"]

_logger = logging.getLogger("trade")

_PARTING_S: Final = 5.0
SHARED_FROM: Final = "shared_from"
"""Metadata of what is at home in another system: its name. What has it is shared no further."""


class Border:
    """Two systems that share some of what they offer; each container acts in its system for the other one's clients.

    A context manager; `close` withdraws everything. The containers stay open: they are their makers'.

    Args:
        ours: a container of one system.
        theirs: a container of another one.
        exported: groups of ours that theirs see and call; ``*`` is all.
        imported: groups of theirs that ours see and call.

    Raises:
        ConfigurationError: both are of one system.
    """

    def __init__(
        self, ours: Container, theirs: Container, *, exported: Sequence[str] = (), imported: Sequence[str] = ()
    ) -> None:
        names = [one.settings.system for one in (ours, theirs)]
        if names[0] == names[1]:
            problem = "a system shares nothing with itself; name another one"
            raise ConfigurationError(where=f"share with {names[0]}", problem=problem)
        with ExitStack() as leaving:
            self.out = BorderDirection(ours, theirs, exported)
            leaving.callback(self.out.close)
            self.back = BorderDirection(theirs, ours, imported)
            leaving.callback(self.back.close)
            self.out.reverse, self.back.reverse = self.back, self.out
            self.out.begin()
            self.back.begin()
            self._leaving = leaving.pop_all()

    def share(self, *, exported: Sequence[str], imported: Sequence[str]) -> None:
        """Go by other lists from now on; what stays shared is not disturbed."""
        self.out.share(exported)
        self.back.share(imported)

    def close(self) -> None:
        """Withdraw everything: what the clients of the other side set moving stops. Idempotent."""
        self._leaving.close()

    def __enter__(self) -> "Border":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class BorderDirection:
    """What is at home in one system and offered in the other one."""

    reverse: "BorderDirection"

    def __init__(self, home: Container, abroad: Container, groups: Sequence[str]) -> None:
        self._home = home
        self._abroad = abroad
        self._groups = tuple(groups)
        self._names = home.settings.system, abroad.settings.system
        self._visitors = GuestSessions(abroad.federating, home, self._names[1])
        self._offered: dict[Exposed, _Offered] = {}
        self._origins: dict[Exposed, Exposed] = {}
        """Places abroad -> at home."""
        self._resources: WeakValueDictionary[tuple[Address, str], SharedResource] = WeakValueDictionary()
        self._refused: dict[Exposed, str] = {}
        self._codec = handle_codec(self._handle_out, self._handle_in)
        self._changed = threading.Event()
        self._leaving = ExitStack()
        self._closed = False
        self._thread = threading.Thread(target=self._keep, name=f"trade-share-{self._names[1]}", daemon=True)

    def begin(self) -> None:
        """Offer what is there, and what comes. Returns when what is there is offered."""
        self._leaving.callback(self._abroad.session_end.subscribe(self._visitors.ended))
        self._leaving.callback(self._visitors.close)
        self._leaving.callback(self._withdraw_all)
        self._leaving.callback(self._home.registry.changes.subscribe(self._note))
        self._reconcile()
        self._thread.start()
        self._leaving.callback(self._end_thread)
        self._home.estopping.subscribe(self._estop)
        self._leaving.callback(self._home.estopping.unsubscribe, self._estop)

    def share(self, groups: Sequence[str]) -> None:
        """Go by another list."""
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
        """Let what is offered abroad be what is there and in the list."""
        there = {
            place: self._told(info)
            for place, info in self._home.federating.offers().items()
            if self._is_shared(place, info)
        }
        for place, offered in list(self._offered.items()):
            if place not in there or there[place].services != offered.info.services:
                self._withdraw(place, offered)
        for place, info in there.items():
            known = self._offered.get(place)
            try:
                if known is None:
                    self._offer(place, info)
                elif structs.replace(info, revision=known.info.revision) != known.info:
                    self._abroad.federating.update(known.provider, info)
                    known.info = info
            except TradeError as refused:
                self._complain(place, str(refused))
        self._refused = {place: why for place, why in self._refused.items() if place in there}

    def _is_shared(self, place: Exposed, info: ProviderInfo) -> bool:
        return SHARED_FROM not in info.meta and inside(place.domain, self._groups)

    def _told(self, info: ProviderInfo) -> ProviderInfo:
        """What is said of it abroad: nothing of what is not shared."""
        members = {group: names for group, names in info.members.items() if inside(group, self._groups)}
        meta = {**info.meta, SHARED_FROM: self._names[0]}
        groups = shown(info, self._groups)
        return structs.replace(info, groups=groups, members=members, meta=meta, estops=())

    def _offer(self, place: Exposed, info: ProviderInfo) -> None:
        home = MemberSystem(
            place, self._home.handle, partial(self._speaking, what=place), self._codec, self._adopt(place)
        )
        offered = _Offered(info)
        offered.place = self._abroad.federating.pass_on(offered.provider, info, home)
        self._origins[offered.place] = place
        self._offered[place] = offered
        self._refused.pop(place, None)

    def _adopt(self, place: Exposed) -> Any:
        def adopt(here: str, there: str) -> SharedResource:
            key = place.address, here
            found = self._resources.get(key)
            if found is None:
                found = self._resources[key] = SharedResource(here, place.address, there, self)
            return found

        return adopt

    def _withdraw(self, place: Exposed, offered: "_Offered") -> None:
        """First what it moves abroad's clients' way: nobody there could stop it afterwards."""
        del self._offered[place]
        with contextlib.suppress(ConfigurationError, ChannelClosed):  # somebody did it before, or all of it is gone
            self._abroad.federating.withdraw(offered.provider)
        self._visitors.leave(place)
        self._origins.pop(offered.place, None)

    def _complain(self, place: Exposed, why: str) -> None:
        if self._refused.get(place) != why:
            self._refused[place] = why
            _logger.error("%s of %s is not shared with %s: %s", place.provider, *self._names, why)

    # --- handles

    def _handle_out(self, handle: Handle) -> ServiceKey:
        """A handle of a service of home, as the other system knows it."""
        key = self._abroad_of(handle.key) or self.reverse.home_of(handle.key)
        if key is None:
            raise TypeError(f"{handle.label} is not shared with system {self._names[1]}")
        return key

    def _handle_in(self, given: ServiceKey) -> Handle:
        """A handle of the other system, as home knows it."""
        key = self.home_of(given) or self.reverse._abroad_of(given)
        if key is None:
            raise msgspec.ValidationError(f"{given.domain}.{given.name} is not shared with system {self._names[0]}")
        return self._home.handle(key)

    def _abroad_of(self, key: ServiceKey) -> ServiceKey | None:
        offered = self._offered.get(Exposed(key.address, key.domain, key.provider))
        return None if offered is None else offered.place.service(key.name)

    def home_of(self, key: ServiceKey) -> ServiceKey | None:
        """A service offered abroad, at home."""
        place = self._origins.get(Exposed(key.address, key.domain, key.provider))
        return None if place is None else place.service(key.name)

    # --- calls and locks that came abroad, and go on at home

    @contextlib.contextmanager
    def _speaking(self, call: CallContext, what: Exposed | None) -> Generator[None]:
        """Calls at home are made on behalf of one that came abroad, under the locks it has shown."""
        if call.session == NO_CLIENT:  # the deadman of our own container: the stop is ours
            sessions, names = [], [str(self._home.address)]
        else:
            sessions = self._visitors.of(call, what)
            names = [session.name for session in sessions]
        calls = () if call.behalf is None else call.behalf.calls
        behalf = Behalf(tuple(names[1:]), calls, ())
        there = structs.replace(call, session=names[0], behalf=behalf, ongoing=None, permit=None)
        locks = self._abroad.borrowed.shown(call)
        with ExitStack() as after:
            after.callback(running.reset, running.set(there))
            after.callback(holding.reset, holding.set(locks))
            after.callback(speaking.reset, speaking.set(sessions[0] if sessions else None))
            yield

    def lock(
        self, call: CallContext, wanted: Wanted, terms: LockRequest, on_lost: OnLost, on_request: OnRequest
    ) -> Lock:
        """Take what is at home for a client from abroad; we renew it as long as the client renews ours."""
        ours = LockRequest(purpose=terms.purpose, lease_s=LEASE_S, wait_s=terms.wait_s)
        asked = {address: list(names) for address, names in wanted.items()}
        with self._speaking(call, None):
            return Lock(
                self._home.locking.lease_client, ours, lambda: Selection(asked), on_lost, on_request, Claim()
            ).acquire()

    def resume(self, call: CallContext, address: Address, names: Sequence[str]) -> list[str]:
        """Let them move again at home, if a client from abroad may say so; which were stopped."""
        with self._speaking(call, None):
            return self._function(address, "resume")(list(names))

    def request_release(self, call: CallContext, address: Address, names: Sequence[str], reason: str) -> list[str]:
        """Ask who has them at home; who was asked."""
        with self._speaking(call, None):
            return self._function(address, "request_release")(list(names), reason)

    def _function(self, address: Address, name: str) -> Handle:
        return self._home.handle(ServiceKey(address, DOMAIN, PROVIDER, name))

    # --- e-stops

    def _estop(self, estop: Estop) -> None:
        """Told by home: an e-stop holds on both sides, and is cleared on each."""
        with contextlib.suppress(ChannelClosed):
            self._abroad.estopping.carry(estop, self._names[0])

    def _end_thread(self) -> None:
        self._closed = True
        self._changed.set()
        self._thread.join(_PARTING_S)

    def _withdraw_all(self) -> None:
        for place, offered in list(self._offered.items()):
            self._withdraw(place, offered)

    def close(self) -> None:
        """Withdraw everything. Idempotent."""
        self._leaving.close()


class _Offered:
    """One provider, as it is offered abroad."""

    place: Exposed

    def __init__(self, info: ProviderInfo) -> None:
        self.info = info
        self.provider: Final = object()
        """Stands for it there."""
