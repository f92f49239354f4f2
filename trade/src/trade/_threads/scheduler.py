"""Threads that do things when they are due.

One of them, the leader, waits for what is due next and does it itself; before that it has another one lead. So nothing
changes hands, and what takes long holds up nothing else until all threads are busy.
"""

import heapq
import itertools
import logging
import threading
import time
from collections.abc import Callable
from typing import Final

_logger = logging.getLogger("trade")

MOST_THREADS: Final = 32
_IDLE_S: Final = 10.0
"""A thread that had nothing to do for so long ends."""
_END_S: Final = 2.0

Callback = Callable[[], "int | None"]
"""Done when it is due; returns when it is due again (``time.monotonic_ns()``), or None."""


class ScheduledTask:
    """Something to be done at its time, and again if it says so; never twice at once."""

    __slots__ = ("_act", "_asked_ns", "_running", "_scheduler", "_turn", "cancelled")

    def __init__(self, scheduler: "Scheduler", act: Callback) -> None:
        self._scheduler = scheduler
        self._act = act
        self._asked_ns: int | None = None
        """When it was wanted again while it ran."""
        self._running = False
        self._turn = 0
        """Its place in the queue; one with another number is old."""
        self.cancelled = False

    def at(self, due_ns: int) -> None:
        """Have it done then, and no more when it was due before; while it runs: once more, then."""
        self._scheduler.enter(self, due_ns)

    def cancel(self) -> None:
        """Do it no more; what runs finishes. Idempotent."""
        self.cancelled = True


class Scheduler:
    """The queue and its threads, of which there are none until something is due.

    Args:
        name: of its threads.
        clock: ``time.monotonic_ns``; a test has its own.
    """

    def __init__(self, name: str, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self._name = name
        self._clock = clock
        self._numbers = itertools.count(1)
        self._queue: list[tuple[int, int, ScheduledTask]] = []
        self._lock = threading.Lock()
        self._sooner = threading.Condition(self._lock)
        """The leader waits here for the time, or for something that is due before."""
        self._followers = threading.Condition(self._lock)
        self._threads: set[threading.Thread] = set()
        self._leading = False
        self._following = 0
        self._called = False
        """A thread was called to lead and has not got there yet."""
        self._closed = False

    def due(self, act: Callback) -> ScheduledTask:
        """Something to be done once it is told when."""
        return ScheduledTask(self, act)

    def begin(self, act: Callback, due_ns: int) -> ScheduledTask:
        """Have something done at a time of ``time.monotonic_ns()``; one that has passed means now."""
        due = self.due(act)
        due.at(due_ns)
        return due

    def enter(self, due: ScheduledTask, due_ns: int) -> None:
        """What `ScheduledTask.at` does."""
        with self._lock:
            if due._running:  # pyright: ignore[reportPrivateUsage] - two halves of one thing
                due._asked_ns = due_ns  # pyright: ignore[reportPrivateUsage]
            else:
                self._push(due, due_ns)

    def _push(self, due: ScheduledTask, due_ns: int) -> None:
        if self._closed or due.cancelled:
            return
        due._turn = next(self._numbers)  # pyright: ignore[reportPrivateUsage]
        heapq.heappush(self._queue, (due_ns, due._turn, due))  # pyright: ignore[reportPrivateUsage]
        if not self._leading:
            self._call_a_leader()
        elif self._queue[0][2] is due:
            self._sooner.notify()

    def _call_a_leader(self) -> None:
        if self._called:
            return
        if self._following:
            self._called = True
            self._followers.notify()
        elif len(self._threads) < MOST_THREADS:
            thread = threading.Thread(target=self._main, name=f"{self._name}-{len(self._threads)}", daemon=True)
            try:
                thread.start()
            except RuntimeError:  # the process may have no more threads; whoever comes back or enters next tries again
                _logger.exception("%s cannot have another thread", self._name)
            else:
                self._called = True
                self._threads.add(thread)

    def _main(self) -> None:
        with self._lock:
            self._called = False
            while (due := self._next()) is not None:
                self._do(due)
            self._threads.discard(threading.current_thread())

    def _next(self) -> ScheduledTask | None:
        """What is due, once it is; None if this thread is not needed. Under the lock, which waiting lets go of."""
        while not self._closed:
            left_ns = self._queue[0][0] - self._clock() if self._queue else None
            if left_ns is not None and left_ns <= 0:
                _, turn, due = heapq.heappop(self._queue)
                if due._turn == turn and not due.cancelled:  # pyright: ignore[reportPrivateUsage]
                    if not self._leading:
                        self._call_a_leader()
                    return due
            elif self._leading:
                self._following += 1
                called = self._followers.wait(_IDLE_S)
                self._following -= 1
                if not called and not self._called:  # it may have been called while its time ran out
                    return None
                self._called = False
            else:
                self._leading = True
                self._sooner.wait(_IDLE_S if left_ns is None else left_ns / 1e9)
                self._leading = False
                if left_ns is None and not self._queue:
                    return None
        return None

    def _do(self, due: ScheduledTask) -> None:
        """Do it without the lock, and put it where it belongs next."""
        due._running, due._asked_ns = True, None  # pyright: ignore[reportPrivateUsage]
        self._lock.release()
        again_ns: int | None = None
        try:
            again_ns = due._act()  # pyright: ignore[reportPrivateUsage]
        except BaseException:
            _logger.exception("%s: something that was due failed and is not done again", self._name)
        finally:
            self._lock.acquire()
            due._running = False  # pyright: ignore[reportPrivateUsage]
            wanted = [ns for ns in (again_ns, due._asked_ns) if ns is not None]  # pyright: ignore[reportPrivateUsage]
            if wanted:
                self._push(due, min(wanted))

    def close(self) -> None:
        """Do nothing more; waits a little for what runs. Idempotent."""
        with self._lock:
            self._closed = True
            self._queue.clear()
            self._sooner.notify_all()
            self._followers.notify_all()
            threads = list(self._threads)
        until = time.monotonic() + _END_S
        for thread in threads:
            if thread is not threading.current_thread():
                thread.join(max(0.0, until - time.monotonic()))
