"""A lock as its owner has it: its parts, and whether they still hold. `lease_client` acquires and renews them."""

import asyncio
import contextlib
import logging
import threading
import time
from collections.abc import Callable, Generator, Iterable
from contextvars import Token as Reset
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from msgspec import structs

from trade._context.call_context import patience_s
from trade._context.outgoing import Claim, Held, holding
from trade._locks.inherited import VARIABLE, passed_on
from trade._protocol.keys import Address
from trade._protocol.messages import Token
from trade._resources.grants import Granted, LockRequest
from trade.errors import ConfigurationError, LockLost, TradeError

if TYPE_CHECKING:
    from trade._locks.lease_client import LeaseClient

_logger = logging.getLogger("trade")


class Selection(NamedTuple):
    """What a lock is to be of, when it is taken."""

    resources: dict[Address, list[str]]
    """By the container that judges them."""
    missing: tuple[str, ...] = ()
    """What belongs to it and was not there."""


Wanted = Callable[[], Selection]
"""Finds what to lock at the moment it is taken; waits until it is there."""
OnLost = Callable[[LockLost], object]
OnRequest = Callable[[str, str], object]
"""Told who would like to have the lock, and why."""


class Lock:
    """Exclusive use of services; a context manager, also of asyncio. Calls made inside carry it; no others get through.

    It holds under leases that are renewed while this process lives. Once lost it stays lost: every actuating call
    inside raises LockLost before anything is sent.
    """

    def __init__(
        self,
        keeper: "LeaseClient",
        terms: LockRequest,
        wanted: Wanted,
        on_lost: OnLost | None,
        on_request: OnRequest | None,
        claim: Claim,
    ) -> None:
        self._lease_client = keeper
        self._terms = terms
        self._wanted = wanted
        self._on_lost = on_lost
        self.on_request = on_request
        """Called, on a thread of its own, when somebody asks for it."""
        self.purpose: Final = terms.purpose
        self.lease_s: Final = terms.lease_s
        self.resources: tuple[str, ...] = ()
        """What it holds, by name."""
        self.missing: tuple[str, ...] = ()
        """What its constraint is for and was not there when it was taken, with ``partial=True``: members of a robot's
        group, and alternatives."""
        self.claim = claim
        """What it selects, and where what it holds of that is."""
        self._granted: dict[Address, Token] = {}
        self._confirmed: dict[Address, float] = {}
        self._lost: LockLost | None = None
        """Why, once it is; it is never raised itself, as it would keep every frame that it went through."""
        self._taken = self._whole = self._ended = False
        self._guard = threading.Lock()
        self._resets: list[Reset[tuple[Held, ...]]] = []

    # --- being used

    def acquire(self) -> "Lock":
        """Take it, once; calls are made under it inside `use`. Entering the context does both.

        Until `release`, or the end of this process, it is renewed and kept from others, used or not.

        Raises:
            NoSuchService, LockedByOther, NotStopped, IncompleteGroup, ServiceGone, ContainerLost, ConfigurationError:
                see `Container.lock`; nothing is held then.
            LockLost: what it had already was lost while it waited for the rest.
        """
        with self._guard:
            if self._taken:
                problem = "a lock is taken once; make another one with trade.lock(...), or share this one with use()"
                raise ConfigurationError(where=f"lock for {self.purpose!r}", problem=problem)
            self._taken = True
        until = time.monotonic() + patience_s(self._terms.wait_s)
        wanted, self.missing = self._wanted()
        left_s = max(0.0, until - time.monotonic())
        for address, names in wanted.items():
            self.claim = self.claim.with_held(address, names)
        self._lease_client.acquire(self, wanted, structs.replace(self._terms, wait_s=left_s))
        self._whole = True
        if self.missing:
            told = self.purpose, ", ".join(self.resources), ", ".join(self.missing)
            _logger.warning("the lock for %r holds %s; missing: %s", *told)
        return self

    @property
    def owner(self) -> Address:
        """The container whose lock it is."""
        return self._lease_client.owner

    @property
    def held(self) -> bool:
        """Whether it holds now, as far as one can know here."""
        return self._whole and self.wanted

    @property
    def wanted(self) -> bool:
        """Whether what it has of its parts is to be kept: it holds, or waits for the others."""
        self._look()
        return not self._ended and self._lost is None

    def tokens(self) -> Iterable[Token]:
        """What shows it to those it was granted by.

        Raises:
            LockLost: it holds no more.
        """
        self.check()
        return () if self._ended else self._granted.values()

    @contextlib.contextmanager
    def use(self) -> Generator["Lock", None, None]:
        """Make calls under it in another thread or task of its owner."""
        reset = holding.set((*holding.get(), self))
        try:
            yield self
        finally:
            holding.reset(reset)

    def environment(self) -> dict[str, str]:
        """What lets a child process make all its calls under it; raises LockLost if it holds no more."""
        return {VARIABLE: passed_on(self.owner, self.resources, list(self.tokens()), self.claim)}

    def release(self) -> None:
        """Give it back. Idempotent."""
        with self._guard:
            if self._ended:
                return
            self._ended = True
        resources = self.resources
        if not self._lease_client.let_go(self) and self._lost is None:
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
            taking.add_done_callback(lambda _: apart(self._lease_client.over, self.release))
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
        state = "not taken" if not self._taken else "lost" if self._lost else "released" if self._ended else "held"
        missing = f", without {', '.join(self.missing)}" if self.missing else ""
        return f"<Lock of {', '.join(self.resources)}, {state}{missing}>"

    # --- being kept

    def take_parts(self) -> dict[Address, Token]:
        """All parts it has, which it has no longer."""
        with self._guard:
            parts, self._granted, self._confirmed, self.resources = self._granted, {}, {}, ()
        return parts

    @property
    def granted(self) -> dict[Address, Token]:
        """Its parts, by the container that granted them; never changed, only replaced."""
        return self._granted

    def add(self, address: Address, granted: Granted, asked_at: float) -> None:
        """One container granted its part; it was asked at that time."""
        with self._guard:
            if granted.token is not None:
                self._confirmed = {**self._confirmed, address: asked_at + granted.waited_s}
                self._granted = {**self._granted, address: granted.token}
            self.resources = tuple(sorted({*self.resources, *granted.resources}))
            self.claim = self.claim.with_held(address, granted.resources)

    def confirm(self, address: Address, number: int, asked_at: float) -> None:
        """One container still holds its part of that number; it was asked at that time."""
        with self._guard:
            if self.has(address, number):
                self._confirmed = {**self._confirmed, address: max(asked_at, self._confirmed[address])}

    def has(self, address: Address, number: int) -> bool:
        """Whether that grant is a part of it (still)."""
        token = self._granted.get(address)
        return token is not None and token.number == number

    def drop(self, address: Address) -> None:
        """That container is gone, and with it all it granted."""
        with self._guard:
            self._granted = {other: token for other, token in self._granted.items() if other != address}

    def check(self) -> None:
        """Raises LockLost if it is lost."""
        self._look()
        if self._lost is not None:
            raise _again(self._lost)

    def refused(self, by: Address, error: LockLost) -> None:
        """A call under it was refused by a container: what that granted is lost, and with it the rest."""
        if by in self._granted and not set(self.resources).isdisjoint(error.resources):
            self.lose(error.reason)

    def _look(self) -> None:
        """On waking, what was not confirmed within the lease is lost before anything is done (S12)."""
        oldest = min(self._confirmed.values(), default=None)
        if oldest is not None and time.monotonic() - oldest >= self.lease_s:
            self.lose(f"it could not be renewed within its lease of {self.lease_s:g} s")

    def lose(self, reason: str) -> None:
        """It does not hold any more; give up the rest of it. Once."""
        with self._guard:
            if self._ended or self._lost is not None:
                return
            self._lost = LockLost(resources=self.resources, reason=reason)
        _logger.warning("%s", self._lost)
        apart(self._lease_client.over, self._lease_client.let_go, self, reason)
        if self._on_lost is not None:
            apart(self._lease_client.over, self._on_lost, _again(self._lost))


def _again(lost: LockLost) -> LockLost:
    return LockLost(resources=lost.resources, reason=lost.reason)


def apart(over: Callable[[], bool], call: Callable[..., object], *arguments: Any) -> None:
    """Call it on a thread of its own: nobody who tells of locks waits for whoever is told.

    Args:
        over: whether the container closes; what that cuts off is no failure.
        call: what to call.
        arguments: with these.
    """

    def guarded() -> None:
        try:
            call(*arguments)
        except Exception as error:
            if over() and isinstance(error, TradeError):
                _logger.debug("told of a lock, %r was cut off as its own container closed: %s", call, error)
            else:
                _logger.exception("told of a lock, %r failed", call)

    threading.Thread(target=guarded, name="trade-lock-told", daemon=True).start()
