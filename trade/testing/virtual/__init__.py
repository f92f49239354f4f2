"""Virtual time: every wait of a test costs nothing, and its order of threads can be tried again."""

import asyncio
import contextlib
import gc
import threading
from collections.abc import Callable, Generator, Sequence, Set
from typing import ClassVar

from trade._container.container import Container
from trade._settings import Settings
from trade._threads import fork_guard
from trade.testing.virtual._descriptors import Descriptors
from trade.testing.virtual._loop import Policy
from trade.testing.virtual._modules import replaced
from trade.testing.virtual._outside import Watch
from trade.testing.virtual._scheduler import Deadlock, Scheduler, VirtualTimeError
from trade.testing.virtual._threads import thread_methods
from trade.transport.base import Transport
from trade.transport.memory import MemoryTransport, Network

__all__ = ["Deadlock", "VirtualTime", "VirtualTimeError", "virtual_time"]


class VirtualTime:
    """The time of one test; made by `virtual_time`."""

    _current: ClassVar["VirtualTime | None"] = None

    def __init__(self, scheduler: Scheduler) -> None:
        self._scheduler = scheduler

    @classmethod
    def current(cls) -> "VirtualTime | None":
        """The one that runs in this process; None on the real clock."""
        return cls._current

    @property
    def elapsed_s(self) -> float:
        """How much virtual time has passed, in seconds."""
        return self._scheduler.elapsed_s

    @property
    def switches(self) -> int:
        """The number of switches to another thread: the same for the same seed."""
        return self._scheduler.switches

    def step_wall_clock(self, by_s: float) -> None:
        """Set the wall clock ahead or back, in seconds; the monotonic clock continues."""
        self._scheduler.wall_step_ns += round(by_s * 1e9)

    def stall_threads(self, probability: float, longest_s: float = 2.0, *, spare: str | tuple[str, ...] = ()) -> None:
        """From now on, threads stand still where another one may run, as on a computer that does not run them.

        Args:
            probability: of each such place, from 0 (none, as at the beginning) to 1.
            longest_s: the longest stall, in seconds.
            spare: how the names of threads begin that are not of this computer, such as those of simulated devices.
        """
        scheduler = self._scheduler
        scheduler.stall, scheduler.longest_stall_s, scheduler.spared = probability, longest_s, spare

    def sleep(self, duration_s: float) -> None:
        """Let time pass, in seconds; other threads run meanwhile."""
        self._scheduler.wait((), duration_s)


@contextlib.contextmanager
def virtual_time(
    seed: int = 0,
    *,
    switch: float = 0.02,
    packages: Sequence[str] = (),
    limit_s: float = 3600.0,
) -> Generator[VirtualTime]:
    """Run what is inside on virtual time: one thread at a time, on a clock that jumps when all of them wait.

    Containers are linked in memory. The real names are put back at the end.

    Args:
        seed: draws the order of threads, and ids; the same seed gives the same run.
        switch: the probability of a switch to another thread where a lock is taken or an event is set, from 0 to 1.
        packages: your packages, whose modules use `threading`, `time` and their like.
        limit_s: how much virtual time may pass, in seconds.

    Raises:
        Deadlock: all threads wait without a deadline; with the stack of each.
        VirtualTimeError: a process or a real socket was used, a thread is left behind, or `limit_s` has passed.
    """
    if VirtualTime._current is not None:
        raise VirtualTimeError("virtual time runs already: a test has one `virtual_time`, or the marker")
    scheduler = Scheduler(seed, switch, limit_s)
    files = Descriptors(scheduler)
    networks: dict[str, Network] = {}

    start = Container.__init__

    def start_in_memory(
        container: Container,
        settings: Settings | None = None,
        *,
        transport: Transport | None = None,
        on_terminate: Callable[[], None] | None = None,
    ) -> None:
        settings = settings or Settings.read()
        network = networks.setdefault(settings.system, Network(seed=seed))
        carried_by = transport or MemoryTransport(network, settings.container)
        start(container, settings, transport=carried_by, on_terminate=on_terminate)

    policy = asyncio.get_event_loop_policy()  # pyright: ignore[reportDeprecated] - Python 3.10 has no other way
    with replaced(scheduler, files, packages) as undo:
        if gc.isenabled():  # a finalizer would run on any thread, also on one that virtual time does not know
            undo.callback(gc.enable)
            gc.disable()
        undo.callback(setattr, Container, "__init__", start)
        Container.__init__ = start_in_memory  # type: ignore[method-assign]
        undo.callback(asyncio.set_event_loop_policy, policy)  # pyright: ignore[reportDeprecated]
        asyncio.set_event_loop_policy(Policy(scheduler, files))  # pyright: ignore[reportDeprecated]
        undo.callback(scheduler.end)
        undo.callback(_forget_containers, set(fork_guard.live))
        undo.callback(setattr, VirtualTime, "_current", None)
        VirtualTime._current = VirtualTime(scheduler)
        undo.callback(Watch(scheduler).close)
        for name, method in thread_methods(scheduler).items():
            undo.callback(setattr, threading.Thread, name, getattr(threading.Thread, name))
            setattr(threading.Thread, name, method)
        try:
            yield VirtualTime._current
        except VirtualTimeError:
            if scheduler.interrupt is not None:  # what was closed after it could not wait any more
                raise scheduler.interrupt from None
            raise
        if scheduler.foreign is not None:
            raise scheduler.foreign
        if left := scheduler.forgotten():
            raise VirtualTimeError(f"threads are left behind: {', '.join(left)}")


def _forget_containers(before: Set[object]) -> None:
    """Containers that a test has left open end with its threads; the process must not close them at its end."""
    for container in set(fork_guard.live) - before:
        fork_guard.live.discard(container)
