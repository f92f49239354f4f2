"""The owner's side of one lock: its parts, and whether they still hold. `lease_client` acquires and renews them."""

import asyncio
import contextlib
import logging
import threading
from collections.abc import Callable, Generator, Iterable
from contextvars import Token as Reset
from types import TracebackType
from typing import Any, Final, NamedTuple, Protocol

from msgspec import structs

from trade._context.call_context import patience_s
from trade._context.outgoing import Claim, UsableLock, holding
from trade._locks.inherited import VARIABLE, passed_on
from trade._resources.grants import Granted, LockRequest
from trade.errors import ConfigurationError, LockLost, TradeError
from trade.protocol.keys import Address
from trade.protocol.messages import Token
from trade.transport.wait_clock import WaitClock

_logger = logging.getLogger("trade")


class Selection(NamedTuple):
    """The resources that a lock will hold."""

    resources: dict[Address, list[str]]
    """By the container that grants their locks."""
    missing: tuple[str, ...] = ()
    """Missing parts of the selection."""


Wanted = Callable[[], Selection]
"""Selects what to lock when the lock is taken; waits until it exists."""
OnLost = Callable[[LockLost], object]
OnRequest = Callable[[str, str], object]
"""Called with the client that requests the lock's release, and its reason."""


class LeaseHolder(Protocol):
    """Takes, renews and gives back the leases of locks, for one container."""

    @property
    def owner(self) -> Address:
        """The container."""
        ...

    @property
    def clock(self) -> WaitClock:
        """The clock of the leases."""
        ...

    def is_closed(self) -> bool:
        """Whether the container closes or is closed."""
        ...

    def acquire(self, lock: "Lock", wanted: dict[Address, list[str]], terms: LockRequest) -> "Lock":
        """Takes all or nothing."""
        ...

    def release(self, lock: "Lock", lost: str = "") -> bool:
        """Gives the leases of a lock back, and renews them no more."""
        ...


class Lock:
    """Exclusive use of services; a context manager, also of asyncio. Only calls made inside it get through.

    It holds under leases that are renewed while this process lives. Once lost it stays lost: every actuating call
    inside raises LockLost before anything is sent.
    """

    def __init__(
        self,
        lease_client: LeaseHolder,
        terms: LockRequest,
        wanted: Wanted,
        on_lost: OnLost | None,
        on_request: OnRequest | None,
        claim: Claim,
        selection: str = "",
    ) -> None:
        self._lease_client = lease_client
        self._terms = terms
        self._wanted = wanted
        self._selection = selection
        self._on_lost = on_lost
        self.on_request = on_request
        """Called, on another thread, when a client requests its release."""
        self.purpose: Final = terms.purpose
        self.lease_s: Final = terms.lease_s
        self.resources: tuple[str, ...] = ()
        """The names of the resources that it holds."""
        self.missing: tuple[str, ...] = ()
        """What its constraint names and was missing when it was taken with ``partial=True``: members of a robot's
        group, and alternatives."""
        self.claim = claim
        """The selection, and the resources of it that the lock holds in each container."""
        self._granted: dict[Address, Token] = {}
        self._confirmed: dict[Address, float] = {}
        self._lost: LockLost | None = None
        """Why it is lost; never raised itself, as it would keep every frame that it passed through."""
        self._is_acquired = self._whole = self._ended = False
        self._guard = threading.Lock()
        self._resets: list[Reset[tuple[UsableLock, ...]]] = []

    # --- being used

    def acquire(self) -> "Lock":
        """Takes the lock, once; make calls under it inside `use`. Entering the context does both.

        Until `release`, or the end of this process, it is renewed and excludes other clients, used or not.

        Raises:
            NoSuchService, LockedByOther, NotStopped, IncompleteGroup, ServiceGone, ContainerLost, ConfigurationError:
                see `Container.lock`; nothing is held then.
            LockLost: a part was lost while it waited for the rest.
        """
        with self._guard:
            if self._is_acquired:
                problem = "a lock is taken once; create another one with trade.lock(...), or share this one with use()"
                raise ConfigurationError(where=f"lock for {self.purpose!r}", problem=problem)
            self._is_acquired = True
        until = self._lease_client.clock.now() + patience_s(self._terms.wait_s)
        wanted, self.missing = self._wanted()
        left_s = max(0.0, until - self._lease_client.clock.now())
        for address, names in wanted.items():
            self.claim = self.claim.with_held(address, names)
        self._lease_client.acquire(self, wanted, structs.replace(self._terms, wait_s=left_s))
        self._whole = True
        if self.missing:
            report = self.purpose, ", ".join(self.resources), ", ".join(self.missing)
            _logger.warning("the lock for %r holds %s; missing: %s", *report)
        return self

    @property
    def owner(self) -> Address:
        """The container that owns it."""
        return self._lease_client.owner

    @property
    def held(self) -> bool:
        """Whether it holds now, as far as is known here."""
        return self._whole and self.wanted

    @property
    def wanted(self) -> bool:
        """Whether to keep its granted parts: it holds, or waits for the others."""
        self._look()
        return not self._ended and self._lost is None

    def tokens(self) -> Iterable[Token]:
        """Its proofs for the containers that granted it.

        Raises:
            LockLost: it no longer holds.
        """
        self.check()
        return () if self._ended else self._granted.values()

    @contextlib.contextmanager
    def use(self) -> Generator["Lock", None, None]:
        """Makes the calls inside under it, in another thread or task of its owner."""
        reset = holding.set((*holding.get(), self))
        try:
            yield self
        finally:
            holding.reset(reset)

    def environment(self) -> dict[str, str]:
        """Environment variables with which a child process makes all calls under it; raises LockLost if it is lost."""
        return {VARIABLE: passed_on(self.owner, self.resources, list(self.tokens()), self.claim)}

    def release(self) -> None:
        """Releases the lock. Idempotent."""
        with self._guard:
            if self._ended:
                return
            self._ended = True
        resources = self.resources
        if not self._lease_client.release(self) and self._lost is None:
            self._lost = LockLost(resources=resources, reason="it was not held any more when it was given back")

    def __enter__(self) -> "Lock":
        self.acquire()
        return self._enter()

    def _enter(self) -> "Lock":
        self._resets.append(holding.set((*holding.get(), self)))
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        holding.reset(self._resets.pop())
        self.release()
        if kind is None and self._lost is not None:
            raise _again(self._lost)

    async def __aenter__(self) -> "Lock":
        taking = asyncio.ensure_future(asyncio.to_thread(self.acquire))
        try:
            await asyncio.shield(taking)
        except asyncio.CancelledError:
            taking.add_done_callback(lambda _: in_own_thread(self._lease_client.is_closed, self.release))
            raise
        return self._enter()

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        holding.reset(self._resets.pop())
        await asyncio.shield(asyncio.ensure_future(asyncio.to_thread(self.release)))
        if kind is None and self._lost is not None:
            raise _again(self._lost)

    def __repr__(self) -> str:
        kept = "not held" if not self._whole else "released" if self._ended else "held"
        state = "lost" if self._lost else kept
        missing = f", without {', '.join(self.missing)}" if self.missing else ""
        return f"<Lock of {', '.join(self.resources) or self._selection}, {state}{missing}>"

    # --- being kept

    def take_parts(self) -> dict[Address, Token]:
        """Removes and returns all its parts."""
        with self._guard:
            parts, self._granted, self._confirmed, self.resources = self._granted, {}, {}, ()
        return parts

    @property
    def granted(self) -> dict[Address, Token]:
        """Its parts, by the container that granted them; replaced, never changed in place."""
        return self._granted

    def add(self, address: Address, granted: Granted, asked_at: float) -> None:
        """Adds the part that one container granted; it was requested at that time."""
        with self._guard:
            if granted.token is not None:
                self._confirmed = {**self._confirmed, address: asked_at + granted.waited_s}
                self._granted = {**self._granted, address: granted.token}
            self.resources = tuple(sorted({*self.resources, *granted.resources}))
            self.claim = self.claim.with_held(address, granted.resources)

    def confirm(self, address: Address, number: int, asked_at: float) -> None:
        """Takes the renewal of one container's part; it was requested at that time."""
        with self._guard:
            if self.has(address, number):
                self._confirmed = {**self._confirmed, address: max(asked_at, self._confirmed[address])}

    def has(self, address: Address, number: int) -> bool:
        """Whether that grant is still a part of it."""
        token = self._granted.get(address)
        return token is not None and token.number == number

    def drop(self, address: Address) -> None:
        """Removes the part of a container that is gone."""
        with self._guard:
            self._granted = {other: token for other, token in self._granted.items() if other != address}

    def check(self) -> None:
        """Raises LockLost if it is lost."""
        self._look()
        if self._lost is not None:
            raise _again(self._lost)

    def refused(self, by: Address, error: LockLost) -> None:
        """Handles the refusal of a call under it: that container's part is lost, and with it the whole lock."""
        if by in self._granted and not set(self.resources).isdisjoint(error.resources):
            self.lose(error.reason)

    def _look(self) -> None:
        """Loses the lock, before any other action, if a part was not renewed within its lease (S12)."""
        oldest = min(self._confirmed.values(), default=None)
        if oldest is not None and self._lease_client.clock.now() - oldest >= self.lease_s:
            self.lose(f"it could not be renewed within its lease of {self.lease_s:g} s")

    def lose(self, reason: str) -> None:
        """Loses the lock, and releases its other parts; only the first call has an effect."""
        with self._guard:
            if self._ended or self._lost is not None:
                return
            self._lost = LockLost(resources=self.resources, reason=reason)
        _logger.warning("%s", self._lost)
        in_own_thread(self._lease_client.is_closed, self._lease_client.release, self, reason)
        if self._on_lost is not None:
            in_own_thread(self._lease_client.is_closed, self._on_lost, _again(self._lost))


def _again(lost: LockLost) -> LockLost:
    return LockLost(resources=lost.resources, reason=lost.reason)


def in_own_thread(closed: Callable[[], bool], call: Callable[..., object], *arguments: Any) -> None:
    """Calls a lock callback on another thread, so that no lock waits for it.

    Args:
        closed: whether the container closes; an error that this causes is not a failure.
        call: the callback.
        arguments: its arguments.
    """

    def guarded() -> None:
        try:
            call(*arguments)
        except Exception as error:
            if closed() and isinstance(error, TradeError):
                _logger.debug("the lock callback %r was cut off, because its container closed: %s", call, error)
            else:
                _logger.exception("the lock callback %r failed", call)

    threading.Thread(target=guarded, name="trade-lock-callback", daemon=True).start()
