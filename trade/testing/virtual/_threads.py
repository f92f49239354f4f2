"""Stand-ins for the names of `threading`: the same behaviour, with all waits in the scheduler."""

import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from trade.testing.virtual._scheduler import Scheduler, Task, VirtualTimeOver, WaitList


class Lock:
    """As `threading.Lock`. Taking it is a place where another thread may run first."""

    _scheduler: Scheduler

    def __init__(self) -> None:
        self._owner: Task | None = None
        self._waiting: WaitList = deque()
        self._number = self._scheduler.number()

    def __hash__(self) -> int:
        """By the order of creation, so that a set of locks has the same order in each run."""
        return self._number

    def acquire(self, blocking: bool = True, timeout: float | None = -1) -> bool:
        scheduler = self._scheduler
        scheduler.may_yield()
        until_ns = None if timeout is None or timeout < 0 else scheduler.now_ns + round(timeout * 1e9)
        while self._owner is not None:
            left_s = None if until_ns is None else (until_ns - scheduler.now_ns) / 1e9
            if not blocking or (left_s is not None and left_s <= 0):
                return False
            scheduler.wait([self._waiting], left_s)
        self._owner = scheduler.current()
        return True

    def release(self) -> None:
        if self._owner is None:
            self._scheduler.current()  # this ends a thread that lost the lock because virtual time is over
            raise RuntimeError("release unlocked lock")
        self._owner = None
        if self._waiting:
            self._scheduler.wake(self._waiting[self._scheduler.random.randrange(len(self._waiting))])

    def locked(self) -> bool:
        return self._owner is not None

    def __enter__(self) -> bool:
        return self.acquire()

    def __exit__(self, *_: object) -> None:
        self.release()

    def _at_fork_reinit(self) -> None:
        self._owner = None
        self._waiting.clear()


class RLock(Lock):
    """As `threading.RLock`."""

    def __init__(self) -> None:
        super().__init__()
        self._count = 0

    def acquire(self, blocking: bool = True, timeout: float | None = -1) -> bool:
        if self._owner is not None and self._owner is self._scheduler.current():
            self._count += 1
            return True
        taken = super().acquire(blocking, timeout)
        self._count = 1 if taken else self._count
        return taken

    def release(self) -> None:
        if self._owner is not self._scheduler.current():
            raise RuntimeError("cannot release un-acquired lock")
        self._count -= 1
        if not self._count:
            super().release()

    def _is_owned(self) -> bool:
        return self._owner is self._scheduler.current()

    def _release_save(self) -> int:
        count, self._count = self._count, 1
        self.release()
        return count

    def _acquire_restore(self, count: int) -> None:
        self.acquire()
        self._count = count


class Condition:
    """As `threading.Condition`."""

    _scheduler: Scheduler
    _new_rlock: Callable[[], RLock]

    def __init__(self, lock: Lock | None = None) -> None:
        self._lock = self._new_rlock() if lock is None else lock
        self._waiters: WaitList = deque()
        self.acquire, self.release = self._lock.acquire, self._lock.release

    def __enter__(self) -> bool:
        return self._lock.__enter__()

    def __exit__(self, *_: object) -> None:
        self._lock.__exit__()

    def wait(self, timeout: float | None = None) -> bool:
        lock = self._lock
        count = lock._release_save() if isinstance(lock, RLock) else lock.release()
        try:
            return self._scheduler.wait([self._waiters], timeout)
        finally:
            if count is not None:
                lock._acquire_restore(count)  # type: ignore[attr-defined]
            else:
                lock.acquire()

    def wait_for(self, predicate: Callable[[], Any], timeout: float | None = None) -> Any:
        until_ns = None if timeout is None else self._scheduler.now_ns + round(timeout * 1e9)
        result = predicate()
        while not result:
            left_s = None if until_ns is None else (until_ns - self._scheduler.now_ns) / 1e9
            if left_s is not None and left_s <= 0:
                break
            self.wait(left_s)
            result = predicate()
        return result

    def notify(self, n: int = 1) -> None:
        for task in list(self._waiters)[:n]:
            self._scheduler.wake(task)

    def notify_all(self) -> None:
        self.notify(len(self._waiters))


class Barrier(threading.Barrier):
    """As `threading.Barrier`, over another condition."""

    _new_condition: Callable[[], Condition]

    def __init__(self, parties: int, action: Callable[[], None] | None = None, timeout: float | None = None) -> None:
        super().__init__(parties, action, timeout)
        self._cond = self._new_condition()


class Event:
    """As `threading.Event`. Setting and clearing it are places where another thread may run."""

    _scheduler: Scheduler

    def __init__(self) -> None:
        self._flag = False
        self._waiters: WaitList = deque()

    def is_set(self) -> bool:
        return self._flag

    def set(self) -> None:
        self._scheduler.refuse_strangers()
        self._flag = True
        self._scheduler.wake_all(self._waiters)
        self._scheduler.may_yield()

    def clear(self) -> None:
        self._scheduler.may_yield()
        self._flag = False

    def wait(self, timeout: float | None = None) -> bool:
        if self._flag:
            self._scheduler.may_yield()
        else:
            self._scheduler.wait([self._waiters], timeout)
        return self._flag

    def _at_fork_reinit(self) -> None:
        self._waiters.clear()


class Semaphore:
    """As `threading.Semaphore`."""

    _scheduler: Scheduler

    def __init__(self, value: int = 1) -> None:
        self._value = value
        self._waiters: WaitList = deque()

    def acquire(self, blocking: bool = True, timeout: float | None = None) -> bool:
        scheduler = self._scheduler
        scheduler.may_yield()
        until_ns = None if timeout is None else scheduler.now_ns + round(timeout * 1e9)
        while not self._value:
            left_s = None if until_ns is None else (until_ns - scheduler.now_ns) / 1e9
            if not blocking or (left_s is not None and left_s <= 0):
                return False
            scheduler.wait([self._waiters], left_s)
        self._value -= 1
        return True

    def release(self, n: int = 1) -> None:
        self._value += n
        for task in list(self._waiters)[:n]:
            self._scheduler.wake(task)

    def __enter__(self) -> bool:
        return self.acquire()

    def __exit__(self, *_: object) -> None:
        self.release()


def thread_methods(scheduler: Scheduler) -> dict[str, Callable[..., Any]]:
    """Methods of `threading.Thread` itself, as classes are derived from it.

    A thread that one of the simulation starts belongs to it. It is a real one, which runs while it has its turn.
    """
    real, tasks = threading.Thread, dict[threading.Thread, Task]()
    real_start, real_join, real_is_alive = real.start, real.join, real.is_alive

    def start(self: threading.Thread) -> None:
        if not scheduler.knows_this_thread():
            real_start(self)
            return
        task, run = Task(self.name), self.run
        self.run = lambda: _run_in_turn(scheduler, task, run)  # type: ignore[method-assign]
        real_start(self)
        tasks[self] = task
        scheduler.add(task, self.ident or 0)
        scheduler.may_yield()

    def join(self: threading.Thread, timeout: float | None = None) -> None:
        task = tasks.get(self)
        if task is None or not scheduler.knows_this_thread():
            real_join(self, timeout)
        elif not task.done:
            scheduler.wait([task.joiners], timeout)

    def is_alive(self: threading.Thread) -> bool:
        task = tasks.get(self)
        return real_is_alive(self) if task is None else not task.done

    return {"start": start, "join": join, "is_alive": is_alive}


def _run_in_turn(scheduler: Scheduler, task: Task, run: Callable[[], None]) -> None:
    task.native_id = threading.get_native_id()
    task.gate.acquire()
    if task.error is not None:
        return
    try:
        run()
    except (VirtualTimeOver, SystemExit):
        pass
    except BaseException:  # noqa: BLE001 - as a thread of threading does
        threading.excepthook(threading.ExceptHookArgs([*sys.exc_info(), threading.current_thread()]))
    finally:
        scheduler.remove(task)


class Timer(threading.Thread):
    """As `threading.Timer`."""

    _new_event: Callable[[], Event]

    def __init__(
        self,
        interval: float,
        function: Callable[..., object],
        args: Iterable[Any] | None = None,
        kwargs: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self.interval, self.function = interval, function
        self.args, self.kwargs = tuple(args or ()), dict(kwargs or {})
        self.finished = self._new_event()

    def cancel(self) -> None:
        self.finished.set()

    def run(self) -> None:
        if not self.finished.wait(self.interval):
            self.function(*self.args, **self.kwargs)
        self.finished.set()


def stand_ins(scheduler: Scheduler) -> dict[str, type]:
    """The classes of one simulation, by their names in `threading`."""
    bound: dict[str, Any] = {"_scheduler": scheduler}
    rlock = type("RLock", (RLock,), bound)
    event = type("Event", (Event,), bound)
    semaphore = type("Semaphore", (Semaphore,), bound)
    condition = type("Condition", (Condition,), {**bound, "_new_rlock": rlock})
    return {
        "Lock": type("Lock", (Lock,), bound),
        "RLock": rlock,
        "Condition": condition,
        "Barrier": type("Barrier", (Barrier,), {"_new_condition": condition}),
        "Event": event,
        "Semaphore": semaphore,
        "BoundedSemaphore": semaphore,
        "Timer": type("Timer", (Timer,), {"_new_event": event}),
    }
