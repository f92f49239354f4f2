"""Threads in real time: SCHED_FIFO of Linux, where the system allows it."""

import os
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil


def why_no_fifo() -> str:
    """Why threads cannot be made SCHED_FIFO here; empty if they can."""
    if not hasattr(os, "sched_setscheduler"):
        return "this system has no SCHED_FIFO"
    try:
        with fifo(lambda: [threading.get_native_id()], 1):
            return ""
    except OSError as refused:
        return f"the system refuses SCHED_FIFO: {refused.strerror}"


@contextmanager
def fifo(threads: Callable[[], Iterable[int]], priority: int) -> Iterator[None]:
    """Have threads of whatever process run as SCHED_FIFO, and those there are at its end as SCHED_OTHER again.

    Args:
        threads: gives their native ids. What they begin meanwhile is in real time, too.
        priority: 1 to 99; the higher one runs first.

    Raises:
        OSError: the system refuses it.
    """
    try:
        _schedule(threads(), os.SCHED_FIFO, priority)
        yield
    finally:
        _schedule(threads(), os.SCHED_OTHER, 0)


def _schedule(threads: Iterable[int], policy: int, priority: int) -> None:
    for thread in threads:
        with suppress(ProcessLookupError):  # it has ended
            os.sched_setscheduler(thread, policy, os.sched_param(priority))


def threads_of(pid: int) -> list[int]:
    """Native ids of the threads of a process; none once it has ended."""
    with suppress(FileNotFoundError):
        return [int(task.name) for task in Path(f"/proc/{pid}/task").iterdir()]
    return []


def threads_below(pid: int) -> list[int]:
    """Those of all processes that this one has started, directly or not."""
    with suppress(psutil.NoSuchProcess):
        return [thread for each in psutil.Process(pid).children(recursive=True) for thread in threads_of(each.pid)]
    return []
