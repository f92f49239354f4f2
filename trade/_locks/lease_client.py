"""The lease client: acquires, renews and releases all locks of a container. One lock: `lock`."""

import contextlib
import math
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final, NoReturn

from msgspec import structs

from trade._calls.client import CallClient
from trade._calls.handle import BoundCall, Handle
from trade._calls.run import Run
from trade._locks.lock import Lock, in_own_thread
from trade._resources.grants import LockRequest
from trade._threads.scheduler import Scheduler
from trade.errors import Busy, ContainerLost, LockedByOther, ServiceGone, SessionEnded, TradeError
from trade.protocol.keys import DOMAIN, PROVIDER, Address, ServiceKey
from trade.protocol.messages import Token

_ANSWER_S: Final = 2.0
"""How long a container may take to answer, beyond the requested wait."""
_AGAIN_S: Final = 0.1
_BEATS: Final = 4
"""Renewals within one lease."""
_END_S: Final = 2.0
_GONE: Final = (ServiceGone, ContainerLost, SessionEnded)
"""Errors of a renewal that say that its grants have ended."""
_FRESH_S: Final = 1.0
"""So long after a client was surely alive, no container has ended its session yet: the link to a frozen client is lost
after two seconds without a sign of life, which are half a second apart."""


class LeaseClient:
    """All locks of a container, and the timer that renews them."""

    def __init__(self, client: CallClient, timers: Scheduler) -> None:
        self._client = client
        self.clock: Final = timers.clock
        self._locks: list[Lock] = []
        self._guard = threading.Lock()
        self._renewals = timers.due(self._renew_all)
        self._closed = False

    @property
    def owner(self) -> Address:
        return self._client.address

    def is_closed(self) -> bool:
        """Whether its container closes or is closed."""
        return self._closed

    # --- taking

    def acquire(self, lock: Lock, wanted: dict[Address, list[str]], terms: LockRequest) -> Lock:
        """Takes all or nothing: first from all containers at once, then one by one in the common order (S13).

        Raises:
            LockedByOther, NotStopped, ServiceGone, ContainerLost: not within ``terms.wait_s``; nothing is held.
            LockLost: one part was lost while it waited for the others; nothing is held.
        """
        began = self.clock.now()
        until = began + terms.wait_s
        self._keep(lock)
        try:
            try:
                self._try_all(lock, wanted, structs.replace(terms, wait_s=0.0))
            except (LockedByOther, Busy):
                self._give_back(lock)
                if self.clock.now() >= until:
                    raise
                self._wait_in_order(lock, wanted, terms, until)
            self._confirm(lock, began)
            lock.check()
        except BaseException:
            lock.release()
            raise
        return lock

    def _try_all(self, lock: Lock, wanted: dict[Address, list[str]], terms: LockRequest) -> None:
        asked_at = self.clock.now()
        asks = [(address, self._ask(address, names, terms)) for address, names in wanted.items()]
        refused: TradeError | None = None
        for address, result in _at_once(asks):
            try:
                lock.add(address, result(), asked_at)
            except TradeError as error:
                refused = refused or error
        if refused is not None:
            raise refused

    def _wait_in_order(self, lock: Lock, wanted: dict[Address, list[str]], terms: LockRequest, until: float) -> None:
        for address in sorted(wanted, key=str):
            while True:
                asked_at = self.clock.now()
                try:
                    ask = self._ask(address, wanted[address], structs.replace(terms, wait_s=max(0.0, until - asked_at)))
                    lock.add(address, ask(), asked_at)
                    lock.check()
                    break
                except Busy:  # its queue is full
                    if self.clock.now() + _AGAIN_S >= until:
                        raise
                    time.sleep(_AGAIN_S)

    def _confirm(self, lock: Lock, asked_at: float) -> None:
        """Renews what was requested too long ago: this process may have been frozen since, and another one granted it.

        A grant that ended with the session of a frozen client still looks new, by the answer that waited for it.
        """
        while self.clock.now() - asked_at >= _FRESH_S and lock.wanted:
            asked_at = self.clock.now()
            held = {address: token.number for address, token in lock.granted.items()}
            asks = [
                (address, self._service(address, "renew").with_(deadline_s=_ANSWER_S).bind([number]))
                for address, number in held.items()
            ]
            for address, result in _at_once(asks):
                try:
                    self._take_renewal(address, [(lock, held[address])], result(), asked_at)
                except TradeError as error:
                    self._not_renewed(address, [(lock, held[address])], error)
                    lock.check()
                    raise

    def _ask(self, address: Address, names: Sequence[str], terms: LockRequest) -> BoundCall:
        ask = self._service(address, "acquire").with_(deadline_s=terms.wait_s + _ANSWER_S)
        return ask.bind(list(names), terms)

    def _service(self, address: Address, name: str) -> Handle:
        return self._client.handle(ServiceKey(address, DOMAIN, PROVIDER, name))

    # --- giving back

    def release(self, lock: Lock, lost: str = "") -> bool:
        """Stops renewing a lock and releases its parts; if it is lost, its motion stops.

        Returns:
            Whether it was held until then, by those containers that answer.
        """
        with self._guard:
            if lock in self._locks:
                self._locks.remove(lock)
        return self._give_back(lock, lost)

    def _give_back(self, lock: Lock, lost: str = "") -> bool:
        parts = lock.take_parts()
        gifts = [
            (address, self._service(address, "release").with_(deadline_s=_ANSWER_S).bind(token.number, lost))
            for address, token in parts.items()
        ]
        held = True
        for _, result in _at_once(gifts):
            with contextlib.suppress(TradeError):  # if the message is lost, the lease ends it
                held &= result()
        return held

    # --- keeping

    def _keep(self, lock: Lock) -> None:
        with self._guard:
            self._locks.append(lock)
        self._renewals.by(_renewal_ns(self.clock.now(), [lock]))

    def _renew_all(self) -> float:
        with self._guard:
            locks = list(self._locks)
        began = self.clock.now()
        self._renew(locks)
        return _renewal_ns(began, locks)

    def _renew(self, locks: Sequence[Lock]) -> None:
        """Sends one renewal to each container, for all its locks; does not wait for the answers."""
        parts: dict[Address, list[tuple[Lock, int]]] = {}
        for lock in locks:
            if lock.wanted:
                for address, token in lock.granted.items():
                    parts.setdefault(address, []).append((lock, token.number))
        for address, held in parts.items():
            asked_at = self.clock.now()
            numbers = [number for _, number in held]
            try:
                run = self._service(address, "renew").with_(deadline_s=_ANSWER_S).start(numbers)
            except TradeError as error:
                self._not_renewed(address, held, error)
            else:
                self.clock.expect(run)
                run.add_done_callback(partial(self._renewed, address, held, asked_at))

    def _renewed(self, address: Address, held: list[tuple[Lock, int]], asked_at: float, run: Run) -> None:
        try:
            over: dict[int, str] = run.result(0)
        except (TradeError, TimeoutError) as error:
            self._not_renewed(address, held, error)
            return
        finally:
            self.clock.arrived(run)
        self._take_renewal(address, held, over, asked_at)

    def _take_renewal(
        self, address: Address, held: list[tuple[Lock, int]], over: dict[int, str], asked_at: float
    ) -> None:
        for lock, number in held:
            if number not in over:
                lock.confirm(address, number, asked_at)
            elif lock.has(address, number):
                lock.lose(over[number])

    def _not_renewed(self, address: Address, held: list[tuple[Lock, int]], error: Exception) -> None:
        if not isinstance(error, _GONE):  # too late or refused: its lease decides
            return
        for lock, number in held:
            if lock.has(address, number):
                lock.drop(address)
                lock.lose(str(error))

    def lost(self, address: Address) -> None:
        """Loses, as a whole, the locks with a part in a container that has ended or cannot be reached (S14)."""
        with self._guard:
            hit = [lock for lock in self._locks if address in lock.granted]
        for lock in hit:
            lock.drop(address)
            lock.lose(f"container {address.container} has ended or cannot be reached")

    def release_requested(self, token: Token, client: str, reason: str) -> bool:
        """Takes a release request for a grant. Returns whether its owner handles requests."""
        with self._guard:
            found = next((lock for lock in self._locks if token in lock.granted.values()), None)
        if found is None or found.on_request is None:
            return False
        in_own_thread(self.is_closed, found.on_request, client, reason)
        return True

    def close(self) -> None:
        """Releases all locks, and renews none any more. Idempotent."""
        self._renewals.cancel()
        with self._guard:
            locks, self._closed = list(self._locks), True
        for lock in locks:
            lock.release()
        self._renewals.cancel(_END_S)


def _renewal_ns(now: float, locks: Sequence[Lock]) -> float:
    """When locks that were renewed now are renewed again, in nanoseconds of the clock."""
    return (now + min((lock.lease_s for lock in locks), default=math.inf) / _BEATS) * 1e9


def _at_once(calls: Sequence[tuple[Address, BoundCall]]) -> list[tuple[Address, Callable[[], Any]]]:
    """Makes calls concurrently; returns a getter for each result. The first call runs on this same thread."""
    if not calls:
        return []
    (first, call), *others = calls
    return [(first, call), *((address, _started(other)) for address, other in others)]


def _started(call: BoundCall) -> Callable[[], Any]:
    try:
        return call.start().result
    except TradeError as error:  # the service is gone; the other calls are made all the same
        return partial(_fail, error)


def _fail(error: TradeError) -> NoReturn:
    raise error
