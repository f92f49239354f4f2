"""A scheduler: threads that run tasks when they are due (leader/followers).

One thread, the leader, waits for the next task, makes another thread the leader, and runs the task itself. So no task
passes between threads, and a slow task delays no other one until all threads are busy.
"""

import heapq
import itertools
import logging
import math
import threading
import time
from collections.abc import Callable
from typing import Final

from trade.transport.wait_clock import WaitClock

_logger = logging.getLogger("trade")

MOST_THREADS: Final = 32
_IDLE_S: Final = 10.0
"""A thread that has been idle for this long ends."""
_END_S: Final = 2.0
NEVER: Final = math.inf

Callback = Callable[[], "float | None"]
"""Runs when it is due; returns when it is due again, in nanoseconds of the clock, or None, or `NEVER`."""


class ScheduledTask:
    """A task that runs at its time, and again if it says so; never twice at once."""

    __slots__ = ("_act", "_asked_ns", "_running", "_scheduler", "_turn", "cancelled", "next_ns")

    def __init__(self, scheduler: "Scheduler", act: Callback) -> None:
        self._scheduler = scheduler
        self._act = act
        self._asked_ns: float | None = None
        """The due time that was requested while it ran."""
        self._running: threading.Thread | None = None
        """The thread that runs it now."""
        self._turn = 0
        """The number of its valid queue entry; entries with another number are outdated."""
        self.next_ns: float = NEVER
        """When it runs next; `NEVER` while it runs, so `by` takes any time then."""
        self.cancelled = False

    @property
    def runs_here(self) -> bool:
        """Whether it runs now, on this same thread."""
        return self._running is threading.current_thread()

    def at(self, due_ns: float) -> None:
        """Runs it at that time instead of its earlier due time; if it runs now, once more at that time."""
        self._scheduler.enter(self, due_ns)

    def by(self, due_ns: float) -> None:
        """Runs it at that time, unless it runs sooner; if it runs now, once more by that time."""
        if due_ns < self.next_ns:
            self._scheduler.enter(self, due_ns, sooner=True)

    def cancel(self, wait_s: float = 0.0) -> None:
        """Runs it no more. Idempotent.

        Args:
            wait_s: how long to wait until a run under way on another thread has ended, in seconds.
        """
        self.cancelled = True
        if wait_s and not self.runs_here:
            self._scheduler.wait_for_end(self, wait_s)


class Scheduler:
    """The queue of tasks and its threads, which start with the first task.

    Args:
        name: the name of its threads.
        clock: the clock of its due times.
    """

    def __init__(self, name: str, clock: WaitClock | None = None) -> None:
        self._name = name
        self.clock: Final = clock or WaitClock()
        self._numbers = itertools.count(1)
        self._queue: list[tuple[float, int, ScheduledTask]] = []
        self._lock = threading.Lock()
        self._sooner = threading.Condition(self._lock)
        """The leader waits here until the next task is due, or for an earlier one."""
        self._followers = threading.Condition(self._lock)
        self._ended = threading.Condition(self._lock)
        """Notified when the run of a cancelled task has ended."""
        self._threads: dict[threading.Thread, None] = {}
        """In the order of their start: `close` joins them in the same order each time."""
        self._leading = False
        self._following = 0
        self._called = False
        """Whether a thread was called to lead and does not lead yet."""
        self._closed = False

    def due(self, act: Callback) -> ScheduledTask:
        """A task that runs once its time is set."""
        return ScheduledTask(self, act)

    def begin(self, act: Callback, due_ns: float) -> ScheduledTask:
        """Runs something at a time of the clock, in nanoseconds; a time in the past means now."""
        due = self.due(act)
        due.at(due_ns)
        return due

    def enter(self, due: ScheduledTask, due_ns: float, *, sooner: bool = False) -> None:
        """Implements `ScheduledTask.at` and `ScheduledTask.by`."""
        with self._lock:
            if due._running:  # pyright: ignore[reportPrivateUsage] - two halves of one thing
                asked_ns = due._asked_ns  # pyright: ignore[reportPrivateUsage]
                if not sooner or asked_ns is None or due_ns < asked_ns:
                    due._asked_ns = due_ns  # pyright: ignore[reportPrivateUsage]
            elif not sooner or due_ns < due.next_ns:
                self._push(due, due_ns)

    def wait_for_end(self, due: ScheduledTask, most_s: float) -> None:
        """Implements `ScheduledTask.cancel`."""
        with self._lock:
            self._ended.wait_for(lambda: due._running is None, most_s)  # pyright: ignore[reportPrivateUsage]
            if (stuck := due._running) is not None:  # pyright: ignore[reportPrivateUsage]
                self._threads.pop(stuck, None)  # `close` does not wait for it once more

    def _push(self, due: ScheduledTask, due_ns: float, *, ran: bool = False) -> None:
        """Queues a task. Requires the lock. If it ran just now, its thread leads unless another one does."""
        if self._closed or due.cancelled:
            return
        due.next_ns = due_ns
        due._turn = next(self._numbers)  # pyright: ignore[reportPrivateUsage]
        heapq.heappush(self._queue, (due_ns, due._turn, due))  # pyright: ignore[reportPrivateUsage]
        if not self._leading:
            if not ran:
                self._call_a_leader()
        elif self._queue[0][2] is due:
            self.clock.expect(self._sooner)
            self._sooner.notify()

    def _call_a_leader(self) -> None:
        if self._called:
            return
        if self._following:
            self._called = True
            self.clock.expect(self._sooner)
            self._followers.notify()
        elif len(self._threads) < MOST_THREADS:
            thread = threading.Thread(target=self._main, name=f"{self._name}-{len(self._threads)}", daemon=True)
            try:
                thread.start()
            except RuntimeError:  # the process may have no more threads; the next task tries again
                _logger.exception("%s cannot have another thread", self._name)
            else:
                self._called = True
                self.clock.expect(self._sooner)
                self._threads[thread] = None

    def _main(self) -> None:
        due = self._first()
        while due is not None:
            due = self._next(due, self._run(due))
        self.clock.arrived()

    def _first(self) -> ScheduledTask | None:
        with self._lock:
            self.clock.expect()
            self._called = False
            return self._take()

    def _next(self, ran: ScheduledTask, again_ns: float | None) -> ScheduledTask | None:
        """Notes that a task ran, and takes the next one."""
        with self._lock:
            ran._running = None  # pyright: ignore[reportPrivateUsage]
            if ran.cancelled:
                self._ended.notify_all()
            wanted = (again_ns, ran._asked_ns)  # pyright: ignore[reportPrivateUsage]
            if (next_ns := min((ns for ns in wanted if ns is not None), default=NEVER)) < NEVER:
                self._push(ran, next_ns, ran=True)
            return self._take()

    def _take(self) -> ScheduledTask | None:
        """The next task, once due; None if this thread is not needed. Requires the lock, and releases it to wait."""
        due = self._wait()
        if due is None:
            self._threads.pop(threading.current_thread(), None)
        else:
            due._running, due._asked_ns = threading.current_thread(), None  # pyright: ignore[reportPrivateUsage]
            due.next_ns = NEVER
        return due

    def _wait(self) -> ScheduledTask | None:
        while not self._closed:
            left_ns = self._queue[0][0] - self.clock.now_ns() if self._queue else None
            if left_ns is not None and left_ns <= 0:
                _, turn, due = heapq.heappop(self._queue)
                if due._turn == turn and not due.cancelled:  # pyright: ignore[reportPrivateUsage]
                    if self._queue and not self._leading:  # otherwise the next task calls one
                        self._call_a_leader()
                    return due
            elif self._leading:
                self._following += 1
                called = self.clock.wait(self._followers, _IDLE_S)
                self._following -= 1
                if not called and not self._called:  # it may have been called while its time expired
                    return None
                self._called = False
            else:
                self._leading = True
                self.clock.wait(self._sooner, _IDLE_S if left_ns is None else left_ns / 1e9)
                self._leading = False
                if left_ns is None and not self._queue:
                    return None
        return None

    def _run(self, due: ScheduledTask) -> float | None:
        """Runs a task; returns when it is due again."""
        try:
            return due._act()  # pyright: ignore[reportPrivateUsage]
        except BaseException:
            _logger.exception("%s: a scheduled task failed and is not repeated", self._name)
            return None

    def close(self) -> None:
        """Runs no more tasks; waits a little for running ones. Idempotent."""
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
