"""Services that run one at a time: one queue for each provider object, without a thread for each waiting call."""

import contextlib
import logging
import threading
from collections import deque
from collections.abc import Callable, Generator
from contextvars import ContextVar
from functools import partial
from typing import Final

_logger = logging.getLogger("trade")

MOST_WAITING: Final = 1024

Job = Callable[[], None]


class Turn:
    """A thread of this process that waits for its turn."""

    __slots__ = ("come", "dropped")

    def __init__(self) -> None:
        self.come = threading.Event()
        self.dropped = False


_held: "ContextVar[tuple[SerialQueue, ...]]" = ContextVar("trade_serial", default=())


def _at_once(work: Job) -> None:
    work()


class SerialQueue:
    """The serial services of one provider, in order of arrival.

    The thread that finds the queue free runs its own call and then the calls queued meanwhile, unless it hands those
    over. Calls from this process run on their callers' threads.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._queue: deque[Job | Turn] = deque()
        self._taken = False

    @property
    def waiting(self) -> int:
        """The number of queued calls."""
        return len(self._queue)

    @property
    def mine(self) -> bool:
        """Whether the running code is a serial service of this provider: its own nested calls do not queue."""
        return self in _held.get()

    @contextlib.contextmanager
    def held(self) -> Generator[None]:
        """Marks the running code as a serial service of this provider."""
        token = _held.set((*_held.get(), self))
        try:
            yield
        finally:
            _held.reset(token)

    def submit(self, job: Job, hand_over: "Callable[[Job], None] | None" = None) -> bool:
        """Runs a job now if the queue is free, else later on another thread. False: the queue is full.

        Args:
            job: the job.
            hand_over: runs the jobs that were queued meanwhile on another thread; none: this thread runs them.
        """
        with self._lock:
            if self._taken:
                if len(self._queue) >= MOST_WAITING:
                    return False
                self._queue.append(job)
                return True
            self._taken = True
        try:
            self._run(job)
        finally:
            following = self._next()
            if following is not None:
                (hand_over or _at_once)(partial(self._drain, following))
        return True

    def withdraw(self, waiting: Job | Turn) -> bool:
        """Take a job or turn out of the queue; False if its turn has come."""
        with self._lock:
            if waiting not in self._queue:
                return False
            self._queue.remove(waiting)
            return True

    def drop(self, turn: Turn) -> None:
        """End a thread's wait: its turn will not come."""
        if self.withdraw(turn):
            turn.dropped = True
            turn.come.set()

    def enter(self, turn: Turn, timeout_s: float | None) -> bool:
        """Wait for the turn of this thread; False after the timeout. Followed by `leave`."""
        with self._lock:
            if not self._taken:
                self._taken = True
                return True
            self._queue.append(turn)
        try:
            return (turn.come.wait(timeout_s) or not self.withdraw(turn)) and not turn.dropped
        except BaseException:
            if not self.withdraw(turn):
                self.leave()
            raise

    def leave(self) -> None:
        """Pass the turn to the next in the queue."""
        job = self._next()
        if job is None:
            return
        try:
            threading.Thread(target=self._drain, args=(job,), name="trade-serial", daemon=True).start()
        except RuntimeError:  # the process may have no more threads
            self._drain(job)

    def _drain(self, job: Job | None) -> None:
        while job is not None:
            self._run(job)
            job = self._next()

    @staticmethod
    def _run(job: Job) -> None:
        try:
            job()
        except Exception:
            _logger.exception("a call of a serial service could not be answered")

    def _next(self) -> Job | None:
        """The next job; None if the queue is empty, or if the next is a waiting thread, which then has the turn."""
        with self._lock:
            if not self._queue:
                self._taken = False
                return None
            following = self._queue.popleft()
        if not isinstance(following, Turn):
            return following
        following.come.set()
        return None
