"""A lock as its owner has it: taken from all containers or from none, renewed, given back, lost. Grants: `_locks`."""

import asyncio
import contextlib
import logging
import threading
import time
from collections.abc import Callable, Generator, Iterable, Sequence
from contextvars import Token as Reset
from functools import partial
from types import TracebackType
from typing import Any, Final, Protocol

from msgspec import structs

from trade._context import Held, holding
from trade._handle import Bound, Handle, Run
from trade._inherited import VARIABLE, passed_on
from trade._locks import Granted, Terms
from trade._system import DOMAIN, PROVIDER
from trade._wire import Address, ServiceKey, Token
from trade.errors import (
    Busy,
    ConfigurationError,
    ContainerLost,
    LockedByOther,
    LockLost,
    ServiceGone,
    TradeError,
)

_logger = logging.getLogger("trade")

_ANSWER_S: Final = 2.0
"""How long a container may take to answer, on top of what it is asked to wait."""
_AGAIN_S: Final = 0.1
_BEATS: Final = 4
"""Renewals within one lease."""

Wanted = Callable[[], dict[Address, list[str]]]
"""Finds what to lock, by the container that judges it, at the moment it is taken."""
OnLost = Callable[[LockLost], object]
OnRequest = Callable[[str, str], object]
"""Told who would like to have the lock, and why."""


class Home(Protocol):
    """What locking asks of its container."""

    @property
    def address(self) -> Address: ...
    def handle(self, key: ServiceKey) -> Handle: ...


class Lock:
    """Exclusive use of services; a context manager, also of asyncio. Calls made inside carry it; no others get through.

    It holds under leases that are renewed while this process lives. Once lost it stays lost: every actuating call
    inside raises LockLost before anything is sent.
    """

    def __init__(
        self, keeper: "Keeper", terms: Terms, wanted: Wanted, on_lost: OnLost | None, on_request: OnRequest | None
    ) -> None:
        self._keeper = keeper
        self._terms = terms
        self._wanted = wanted
        self._on_lost = on_lost
        self.on_request = on_request
        """Called, on a thread of its own, when somebody asks for it."""
        self.purpose: Final = terms.purpose
        self.lease_s: Final = terms.lease_s
        self.resources: tuple[str, ...] = ()
        """What it holds, by name."""
        self._granted: dict[Address, Token] = {}
        self._confirmed: dict[Address, float] = {}
        self._lost: LockLost | None = None
        self._ended = self._taken = False
        self._guard = threading.Lock()
        self._resets: list[Reset[tuple[Held, ...]]] = []

    # --- being used

    def acquire(self) -> "Lock":
        """Take it: what entering the context does. Once; whoever wants it again makes another one.

        Raises:
            LockedByOther, DeviceSilent, IncompleteGroup, ServiceGone, ContainerLost, ConfigurationError: see
                `Container.lock`; nothing is held then.
        """
        with self._guard:
            if self._taken:
                problem = "a lock is taken once; make another one with trade.lock(...), or share this one with use()"
                raise ConfigurationError(where=f"lock for {self.purpose!r}", problem=problem)
            self._taken = True
        self._keeper.acquire(self, self._wanted(), self._terms)
        return self

    @property
    def owner(self) -> Address:
        """The container whose lock it is."""
        return self._keeper.owner

    @property
    def held(self) -> bool:
        """Whether it holds now, as far as one can know here."""
        self._look()
        return self._taken and not self._ended and self._lost is None

    def tokens(self) -> Iterable[Token]:
        """What shows it to those it was granted by.

        Raises:
            LockLost: it holds no more.
        """
        self._look()
        if self._lost is not None:
            raise self._lost
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
        return {VARIABLE: passed_on(self.owner, self.resources, list(self.tokens()))}

    def release(self) -> None:
        """Give it back. Idempotent."""
        with self._guard:
            if self._ended:
                return
            self._ended = True
        self._keeper.let_go(self)

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
            raise self._lost

    async def __aenter__(self) -> "Lock":
        taking = asyncio.ensure_future(asyncio.to_thread(self.acquire))
        try:
            await asyncio.shield(taking)
        except asyncio.CancelledError:
            taking.add_done_callback(lambda _: _apart(self.release))
            raise
        return self._enter()

    async def __aexit__(self, *exit_: Any) -> None:
        await asyncio.to_thread(self.release)
        self.__exit__(*exit_)

    def __repr__(self) -> str:
        state = "not taken" if not self._taken else "lost" if self._lost else "released" if self._ended else "held"
        return f"<Lock of {', '.join(self.resources)}, {state}>"

    # --- being kept

    def take_parts(self) -> dict[Address, Token]:
        """All parts it has, which it has no longer."""
        with self._guard:
            parts, self._granted, self._confirmed, self.resources = self._granted, {}, {}, ()
        return parts

    @property
    def granted(self) -> dict[Address, Token]:
        """Its parts, by the container that granted them."""
        return self._granted

    def add(self, address: Address, granted: Granted, asked_at: float) -> None:
        """One container granted its part; it was asked at that time."""
        if granted.token is not None:
            self._confirmed[address] = asked_at + granted.waited_s
            self._granted[address] = granted.token
        self.resources = tuple(sorted({*self.resources, *granted.resources}))

    def confirm(self, address: Address, asked_at: float) -> None:
        """One container still holds it; it was asked at that time."""
        self._confirmed[address] = max(asked_at, self._confirmed[address])

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
        _apart(self._keeper.let_go, self, reason)
        if self._on_lost is not None:
            _apart(self._on_lost, self._lost)


class Keeper:
    """Every lock of a container, and the thread that renews them while there are any."""

    def __init__(self, home: Home) -> None:
        self._home = home
        self._locks: list[Lock] = []
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        self._closed = False

    @property
    def owner(self) -> Address:
        return self._home.address

    # --- taking

    def acquire(self, lock: Lock, wanted: dict[Address, list[str]], terms: Terms) -> Lock:
        """Take all or nothing: all containers at once first, then one after the other in the order all keep (S13).

        Raises:
            LockedByOther, DeviceSilent, ServiceGone, ContainerLost: not within ``terms.wait_s``; nothing is held.
        """
        until = time.monotonic() + terms.wait_s
        self._keep(lock)
        try:
            try:
                self._try_all(lock, wanted, structs.replace(terms, wait_s=0.0, drain_s=terms.wait_s))
            except (LockedByOther, Busy):
                self._give_back(lock)
                if time.monotonic() >= until:
                    raise
                self._wait_in_order(lock, wanted, terms, until)
        except BaseException:
            lock.release()
            raise
        return lock

    def _try_all(self, lock: Lock, wanted: dict[Address, list[str]], terms: Terms) -> None:
        asked_at = time.monotonic()
        asks = [(address, self._ask(address, names, terms)) for address, names in wanted.items()]
        refused: TradeError | None = None
        for address, result in _at_once(asks):
            try:
                lock.add(address, result(), asked_at)
            except TradeError as error:
                refused = refused or error
        if refused is not None:
            raise refused

    def _wait_in_order(self, lock: Lock, wanted: dict[Address, list[str]], terms: Terms, until: float) -> None:
        for address in sorted(wanted, key=str):
            while True:
                asked_at = time.monotonic()
                left_s = max(0.0, until - asked_at)
                try:
                    ask = self._ask(address, wanted[address], structs.replace(terms, wait_s=left_s, drain_s=left_s))
                    lock.add(address, ask(), asked_at)
                    break
                except Busy:  # its queue is full
                    if time.monotonic() + _AGAIN_S >= until:
                        raise
                    time.sleep(_AGAIN_S)

    def _ask(self, address: Address, names: Sequence[str], terms: Terms) -> Bound:
        ask = self._service(address, "acquire").with_(deadline_s=terms.wait_s + terms.drain_s + _ANSWER_S)
        return ask.bind(list(names), terms)

    def _service(self, address: Address, name: str) -> Handle:
        return self._home.handle(ServiceKey(address, DOMAIN, PROVIDER, name))

    # --- giving back

    def let_go(self, lock: Lock, lost: str = "") -> None:
        """Renew it no more, and give back what is held of it; if it is lost, what it moves stops."""
        with self._changed:
            if lock in self._locks:
                self._locks.remove(lock)
        self._give_back(lock, lost)

    def _give_back(self, lock: Lock, lost: str = "") -> None:
        parts = lock.take_parts()
        gifts = [
            (address, self._service(address, "release").with_(deadline_s=_ANSWER_S).bind(token.number, lost))
            for address, token in parts.items()
        ]
        for _, result in _at_once(gifts):
            with contextlib.suppress(TradeError):  # where it is not heard, its lease ends it
                result()

    # --- keeping

    def _keep(self, lock: Lock) -> None:
        with self._changed:
            self._locks.append(lock)
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="trade-locks", daemon=True)
                self._thread.start()
            self._changed.notify_all()

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._locks and not self._closed:
                    self._changed.wait()
                if self._closed:
                    return
                locks = list(self._locks)
            self._renew(locks)
            with self._changed:
                self._changed.wait_for(lambda: self._closed, min(lock.lease_s for lock in locks) / _BEATS)

    def _renew(self, locks: Sequence[Lock]) -> None:
        """One call for each container, whatever the number of locks; nobody waits for the answers here."""
        parts: dict[Address, list[tuple[Lock, int]]] = {}
        for lock in locks:
            if lock.held:
                for address, token in lock.granted.items():
                    parts.setdefault(address, []).append((lock, token.number))
        for address, held in parts.items():
            asked_at = time.monotonic()
            numbers = [number for _, number in held]
            run = self._service(address, "renew").with_(deadline_s=_ANSWER_S).start(numbers)
            run.when_done(partial(self._renewed, address, held, asked_at))

    def _renewed(self, address: Address, held: list[tuple[Lock, int]], asked_at: float, run: Run) -> None:
        try:
            live = set(run.result(0))
        except (ServiceGone, ContainerLost) as gone:
            for lock, _ in held:
                lock.lose(str(gone))
            return
        except (TradeError, TimeoutError):  # too late or refused: its own lease judges
            return
        for lock, number in held:
            if number in live:
                lock.confirm(address, asked_at)
            else:
                lock.lose(f"container {address.container} granted it to nobody any more")

    def lost(self, address: Address) -> None:
        """A container has ended or cannot be reached: locks it has a part in are lost as a whole (S14)."""
        with self._changed:
            hit = [lock for lock in self._locks if address in lock.granted]
        for lock in hit:
            lock.lose(f"container {address.container} has ended or cannot be reached")

    def asked(self, token: Token, who: str, reason: str) -> bool:
        """Somebody would like to have what a grant holds. Returns whether its owner has an ear for that."""
        with self._changed:
            found = next((lock for lock in self._locks if token in lock.granted.values()), None)
        if found is None or found.on_request is None:
            return False
        _apart(found.on_request, who, reason)
        return True

    def close(self) -> None:
        """Give everything back and end the thread. Idempotent."""
        with self._changed:
            locks, self._closed = list(self._locks), True
            self._changed.notify_all()
        for lock in locks:
            lock.release()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(2)


def _at_once(calls: Sequence[tuple[Address, Bound]]) -> list[tuple[Address, Callable[[], Any]]]:
    """Make calls side by side, the last one on this very thread; returns how to get each result."""
    if not calls:
        return []
    *others, (last, call) = calls
    return [*((address, other.start().result) for address, other in others), (last, call)]


def _apart(call: Callable[..., object], *arguments: Any) -> None:
    """Call it on a thread of its own: nobody who tells of locks waits for whoever is told."""

    def guarded() -> None:
        try:
            call(*arguments)
        except Exception:
            _logger.exception("told of a lock, %r failed", call)

    threading.Thread(target=guarded, name="trade-lock-told", daemon=True).start()
