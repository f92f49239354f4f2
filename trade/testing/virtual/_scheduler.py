"""Runs threads one at a time, in an order drawn from a seed, on a clock that jumps when all of them wait.

Each thread is a real one with a gate. The thread that runs is the current task; it hands over by opening the gate of
the next one and waiting at its own. So there is one place where the order of threads is decided: `Scheduler._next`.
"""

import _thread
import contextlib
import heapq
import itertools
import random
import sys
import threading
import traceback
from collections import deque
from collections.abc import Iterable
from types import FrameType
from typing import Final

WaitList = deque["Task"]
"""The tasks that wait for one thing, in the order in which they came."""

_BEGIN_NS: Final = 1_000_000_000_000
_WALL_NS: Final = 1_700_000_000_000_000_000
_READ_NS: Final = 1_000
_READS_BEFORE_MORE: Final = 1_000
_LONGEST_READ_NS: Final = 1_000_000
_FRAMES: Final = 6
_FOLDER: Final = "trade/testing/virtual/"


class VirtualTimeError(RuntimeError):
    """What virtual time cannot do was tried; the message names it."""


class Deadlock(VirtualTimeError):
    """All threads wait, and no wait has a deadline; the message has the stack of each."""


class VirtualTimeOver(BaseException):
    """Raised in threads that still run when virtual time is over, to end them."""


class Task:
    """A thread of the simulation."""

    def __init__(self, name: str, ident: int | None = None) -> None:
        self.name = name
        self.ident = ident
        self.native_id = 0
        """Its number in the kernel, while it runs."""
        self.gate: Final = _thread.allocate_lock()
        self.gate.acquire()
        self.turn = 0
        """Counts its waits, so that the timer of an earlier wait wakes no thread."""
        self.woken = False
        self.waits_in: tuple[WaitList, ...] = ()
        self.joiners: Final[WaitList] = deque()
        self.error: BaseException | None = None
        self.done = False


class Scheduler:
    """The clock and the order of threads.

    Args:
        seed: draws the order; the same seed gives the same run.
        switch: the probability of a switch to another ready thread where a lock is taken or an event is set.
        limit_s: how much virtual time may pass, in seconds; more is an error, as in a test that waits in circles.
    """

    def __init__(self, seed: int, switch: float, limit_s: float) -> None:
        self.random: Final = random.Random(seed)  # noqa: S311 - it draws orders, no secrets
        self.numbers: Final = random.Random(~seed)  # noqa: S311 - what a program draws changes no order
        self.now_ns = _BEGIN_NS
        self.wall_step_ns = 0
        """How far the wall clock was set, in nanoseconds."""
        self.switches = 0
        self._switch = switch
        self.stall = 0.0
        """The probability of a stall where another thread may run."""
        self.longest_stall_s = 0.0
        self.spared: str | tuple[str, ...] = ()
        """How the names of threads begin that never stall."""
        self.importing = 0
        """How many imports are under way. They switch no threads, as only the first run of a process has them."""
        self._limit_ns = _BEGIN_NS + round(limit_s * 1e9)
        self._reads = 0
        self._ready: list[Task] = []
        self._timers: list[tuple[int, int, Task, int]] = []
        self._order = itertools.count()
        self._tasks: dict[int, Task] = {}
        self._main: Final = Task("main", _thread.get_ident())
        self._current = self._main
        self._tasks[_thread.get_ident()] = self._main
        self._ended = False
        self._main.native_id = threading.get_native_id()
        self.interrupt: BaseException | None = None
        """Ctrl-C, or a time limit of the test's runner, that reached the main thread while it waited."""
        self.foreign: VirtualTimeError | None = None
        """What a thread that is not part of virtual time did."""

    # --- the clock

    @property
    def elapsed_s(self) -> float:
        """How much virtual time has passed, in seconds."""
        return (self.now_ns - _BEGIN_NS) / 1e9

    def monotonic_ns(self) -> int:
        """The time. Reading it costs some, and ever more without a wait, so that a loop that only reads it ends."""
        self._reads += 1
        more = max(0, self._reads - _READS_BEFORE_MORE)
        self.now_ns += min(_READ_NS * (1 + more), _LONGEST_READ_NS)
        if more and self._ready and not more % 100:
            self.yield_now()
        return self.now_ns

    def wall_ns(self) -> int:
        """The wall clock, which advances as the other one does."""
        return self.monotonic_ns() - _BEGIN_NS + _WALL_NS + self.wall_step_ns

    def number(self) -> int:
        """The next of the numbers of what is made."""
        return next(self._order)

    # --- waiting and waking

    def wait(self, lists: Iterable[WaitList], timeout_s: float | None) -> bool:
        """Wait until another thread wakes this one; False if the time is over first."""
        me = self._me()
        me.woken, me.waits_in = False, tuple(lists)
        for waiting in me.waits_in:
            waiting.append(me)
        if timeout_s is not None:
            due_ns = self.now_ns + max(0, round(timeout_s * 1e9))
            heapq.heappush(self._timers, (due_ns, next(self._order), me, me.turn))
        self._hand_over(me)
        return me.woken

    def sleep(self, duration_s: float) -> None:
        """Let time pass, in seconds; other threads run meanwhile."""
        self.wait((), duration_s)

    def wake(self, task: Task, woken: bool = True) -> None:
        """Make a waiting thread ready."""
        task.turn += 1
        task.woken = woken
        for waiting in task.waits_in:
            with contextlib.suppress(ValueError):
                waiting.remove(task)
        task.waits_in = ()
        self._ready.append(task)

    def wake_all(self, waiting: WaitList) -> None:
        """Make all threads of a list ready."""
        for task in list(waiting):
            self.wake(task)

    def may_yield(self) -> None:
        """A place where another thread may run, with the probability of a switch or a stall."""
        if self.importing:
            return
        stalls = self.stall and self.random.random() < self.stall
        if stalls and not self._current.name.startswith(self.spared):
            self.sleep(self.random.random() * self.longest_stall_s)
        if self._ready and self._switch and self.random.random() < self._switch:
            self.yield_now()

    def yield_now(self) -> None:
        """Let another ready thread run, if the seed says so."""
        me = self._me()
        self._ready.append(me)
        self._hand_over(me)

    # --- threads

    def add(self, task: Task, ident: int) -> None:
        """A thread has started; it waits at its gate."""
        task.ident = ident
        self._tasks[ident] = task
        self._ready.append(task)

    def remove(self, task: Task) -> None:
        """The current thread is about to end."""
        task.done = True
        self.wake_all(task.joiners)
        self._tasks.pop(task.ident or 0, None)
        if not self._ended:
            self._go_to(self._next_or_deadlock())

    def current(self) -> Task:
        """The thread that runs."""
        return self._me()

    def forgotten(self) -> list[str]:
        """The names of threads that have not ended."""
        return [task.name for task in self._tasks.values() if task is not self._main]

    @property
    def running_native_id(self) -> int:
        """The kernel's number of the thread that runs."""
        return self._current.native_id

    def knows_this_thread(self) -> bool:
        """Whether the caller is a thread of the simulation."""
        return not self._ended and _thread.get_ident() in self._tasks

    def refuse_strangers(self) -> None:
        """Raises VirtualTimeError in a thread that virtual time did not start, while it runs."""
        if not self._ended:
            self._me()

    def give_up(self, waited_s: float) -> None:
        """Called beside the simulation: the thread that runs waits for something that virtual time does not have."""
        stuck = self._current
        stack = self._stack(stuck, sys._current_frames().get(stuck.ident or 0))
        what = f"for {waited_s:g} s, in a library in C, or in a module that is not named in packages="
        self._main.error = VirtualTimeError(f"{stuck.name} has waited outside of virtual time {what}:\n{stack}")
        if stuck is not self._main:
            self._current = self._main
            self._main.gate.release()

    def end(self) -> None:
        """End all threads that still run: each gets `VirtualTimeOver` where it waits."""
        if self._ended:
            return
        self._ended = True
        for task in list(self._tasks.values()):
            if task is not self._main:
                task.error = VirtualTimeOver()
                with contextlib.suppress(RuntimeError):  # it is open: the thread that ran just now has opened it
                    task.gate.release()

    # --- the order

    def _me(self) -> Task:
        task = self._tasks.get(_thread.get_ident())
        if self._ended:
            raise self.interrupt or VirtualTimeError("virtual time is over") if task is self._main else VirtualTimeOver
        if task is not self._current:
            known = next((one for one in threading.enumerate() if one.ident == _thread.get_ident()), None)
            why = "it was there before virtual time began" if task is None else "it waits outside of virtual time"
            name = "of a library in C" if known is None else known.name
            error = VirtualTimeError(f"thread {name} ran beside {self._current.name}: {why}")
            if known is not None and not isinstance(known, threading._DummyThread):  # a library hears of it itself
                self.foreign = error
            raise error
        return self._current

    def _hand_over(self, me: Task) -> None:
        self._reads = 0
        following = self._next_or_deadlock()
        if following is not me:
            self._go_to(following)
            try:
                me.gate.acquire()
            except BaseException as interrupt:  # Ctrl-C or a time limit of the test's runner reached the main thread
                self.interrupt = interrupt
                self.end()
                raise
        if me.error is not None:
            error, me.error = me.error, None
            raise error

    def _go_to(self, task: Task) -> None:
        self.switches += 1
        self._current = task
        task.gate.release()

    def _next_or_deadlock(self) -> Task:
        following = self._next()
        if following is None:
            self._fail(Deadlock("all threads wait, and nothing will wake one of them:\n" + self._stacks()))
            following = self._next()
        elif self.now_ns > self._limit_ns and self._main.error is None:
            passed = f"more than {(self._limit_ns - _BEGIN_NS) / 1e9:g} s of virtual time have passed"
            self._limit_ns = sys.maxsize
            self._fail(VirtualTimeError(f"{passed}; say limit_s= if that is right:\n{self._stacks()}"))
        return self._main if following is None else following

    def _next(self) -> Task | None:
        while not self._ready:
            while self._timers and self._timers[0][3] != self._timers[0][2].turn:
                heapq.heappop(self._timers)
            if not self._timers:
                return None
            due_ns, _, task, _ = heapq.heappop(self._timers)
            self.now_ns = max(self.now_ns, due_ns)
            self.wake(task, woken=False)
        at = self.random.randrange(len(self._ready)) if len(self._ready) > 1 else 0
        self._ready[at], self._ready[-1] = self._ready[-1], self._ready[at]
        return self._ready.pop()

    def _fail(self, error: VirtualTimeError) -> None:
        self._main.error = error
        if self._main not in self._ready:
            self.wake(self._main, woken=False)

    def _stacks(self) -> str:
        frames = sys._current_frames()
        return "\n".join(self._stack(task, frames.get(task.ident or 0)) for task in self._tasks.values())

    def _stack(self, task: Task, frame: FrameType | None) -> str:
        lines = traceback.format_stack(frame) if frame is not None else []
        own = [line for line in lines if _FOLDER not in line.replace("\\", "/")]
        return f"--- {task.name}\n{''.join(own[-_FRAMES:])}"
