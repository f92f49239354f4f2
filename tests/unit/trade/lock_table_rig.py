"""A lock table by itself, for the tests of it: its clock and its stops are the test's."""

import concurrent.futures
from collections.abc import Callable, Iterable, Sequence

from tests.support.waiting import wait_until
from trade._resources.grants import Granted, LockRequest
from trade._resources.lock_table import LockTable
from trade._resources.resource import Holder, Permit, Resource, admit
from trade._threads.scheduler import Scheduler
from trade.protocol.messages import Token
from trade.transport.wait_clock import WaitClock

EPOCH = "epoch"
LONG_S = 1e6
NAMES = ("a", "b", "c", "d")
COUPLED = {"c": ("d",), "d": ("c",)}


class Now(WaitClock):
    """A clock that reads a test's time; waits on it end with a notification."""

    def __init__(self, read: Callable[[], float]) -> None:
        self._read = read

    def now(self) -> float:
        return self._read()

    def now_ns(self) -> int:
        return int(self._read())


class Table:
    """A lock table whose clock and whose stops are the test's.

    Args:
        clock: gives the seconds; default: `now`, which a test sets.
    """

    def __init__(self, clock: Callable[[], float] | None = None) -> None:
        self.now = 0.0
        timers = Scheduler("closed", Now(clock or (lambda: self.now)))
        timers.close()  # leases end by `advance`, on no other thread
        self.table = LockTable(EPOCH, "home", timers)
        self.resources = {name: self.table.adopt(Resource(name, coupled=COUPLED.get(name, ()))) for name in NAMES}
        self.stopping: list[tuple[Resource, Callable[[Resource, str], None]]] = []
        self.table.stop_with(self._stop)
        self.pool = concurrent.futures.ThreadPoolExecutor(40)

    def _stop(self, resources: Sequence[Resource], _: str, done: Callable[[Resource, str], None]) -> None:
        for resource in resources:
            resource.stop("trade")
            self.stopping.append((resource, done))

    def acquire(self, names: Iterable[str], session: str = "s", calls: Iterable[int] = (), **terms: object) -> Granted:
        holder = Holder("tester", session, session, "test", 0.0)
        tokens = terms.pop("tokens", ())
        return self.table.acquire(list(names), holder, LockRequest(**terms), tokens, calls)  # type: ignore[arg-type]

    def take(self, names: Iterable[str], session: str = "s", **terms: object) -> Token:
        token = self.acquire(names, session, **terms).token
        assert token is not None
        return token

    def ask(self, names: Iterable[str], session: str = "s", **terms: object) -> "concurrent.futures.Future[Granted]":
        """Ask on a thread; returns once it is granted, refused or waits."""
        before = self.table._count
        asking = self.pool.submit(self.acquire, list(names), session, **{"wait_s": LONG_S, **terms})
        wait_until(lambda: asking.done() or self.table._count > before)
        return asking

    def call(self, names: Iterable[str], tokens: Iterable[Token] = (), session: str = "s", call_id: int = 0) -> Permit:
        resources = [self.resources[name] for name in names]
        return admit(
            resources, call_id=call_id, caller="tester", tokens=tuple(tokens), sessions=(session,), cancel=None
        )

    def advance(self, duration_s: float) -> None:
        self.now += duration_s
        self.table.expire()
        with self.table._changed:
            self.table._changed.notify_all()

    def close(self) -> None:
        self.table.close()
        self.pool.shutdown()
