"""Real time: Linux runs a whole process before ordinary ones (SCHED_FIFO), and keeps its memory out of swap.

A bus thread alone would wait for the interpreter, which an ordinary thread of its process may hold while it waits for a
processor. So all threads of the process get the priority, and later ones inherit it.
"""

import ctypes
import logging
import os
import threading
import time
from pathlib import Path
from typing import Final

PRIORITY: Final = 10
"""Below the kernel's own threads, which have 50."""
_MOST_SHARE: Final = 0.8
"""The largest share of a processor that a process in real time may use; the kernel gives it 95 %."""
_EACH_S: Final = 1.0
"""The time over which the share is measured, at least: the kernel gives the share in each second."""
_TIMES: Final = 2
"""How often in succession it is too much."""
_KILLED_AFTER_S: Final = 10.0
"""How long one of its threads may compute without a wait. The interpreter is held, so only the kernel can end it."""
_LOCK_WHAT_IS_USED: Final = 1 | 2 | 4
"""MCL_CURRENT, MCL_FUTURE and MCL_ONFAULT of mlockall(2)."""
_THREADS: Final = Path("/proc/self/task")
_logger: Final = logging.getLogger("trade")


def refusal() -> str:
    """Why this process may not run in real time; empty if it may. Changes nothing."""
    if not hasattr(os, "sched_setscheduler"):
        return "this operating system has no SCHED_FIFO"
    me = threading.get_native_id()
    try:
        os.sched_setscheduler(me, os.SCHED_FIFO, os.sched_param(PRIORITY))
        os.sched_setscheduler(me, os.SCHED_OTHER, os.sched_param(0))
    except OSError as refused:
        return f"the operating system refuses SCHED_FIFO: {refused.strerror}"
    return ""


class RealTime:
    """The real time of this process. For its main thread."""

    def __init__(self) -> None:
        self._taken = False
        self._seen = (0.0, 0.0)
        """The time of the last look, and the processor time used until then, in seconds."""
        self._busy = 0

    def take(self) -> list[str]:
        """Runs all threads of this process in real time and locks its memory, as far as allowed.

        Processes that it starts later inherit the priority. If a thread computes for ten seconds without a wait, Linux
        kills its process: the thread holds the interpreter. The devices' watchdogs have stopped them long before.

        Returns:
            What was refused, and why; empty if nothing was.
        """
        if why := refusal():
            return [why]
        import resource  # noqa: PLC0415 - Unix only

        _, most_us = resource.getrlimit(resource.RLIMIT_RTTIME)
        if most_us == resource.RLIM_INFINITY:
            most_us = int(_KILLED_AFTER_S * 1e6)
            resource.setrlimit(resource.RLIMIT_RTTIME, (most_us, most_us))
        _schedule(os.SCHED_FIFO, PRIORITY)
        self._taken, self._seen = True, (time.monotonic(), time.process_time())
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.mlockall(_LOCK_WHAT_IS_USED) == 0:
            return []
        return [f"the operating system refuses to lock its memory: {os.strerror(ctypes.get_errno())}"]

    def watch(self) -> None:
        """Makes the process ordinary, with an error in the log, if it keeps a processor busy. To be called often."""
        if not self._taken:
            return
        (before, used_before), now = self._seen, (time.monotonic(), time.process_time())
        if now[0] - before < _EACH_S:
            return
        share, self._seen = (now[1] - used_before) / (now[0] - before), now
        self._busy = self._busy + 1 if share > _MOST_SHARE else 0
        if self._busy >= _TIMES:
            self._taken = False
            _schedule(os.SCHED_OTHER, 0)
            _logger.error(
                "this process used %.0f %% of a processor for seconds; it is no longer in real time", 100 * share
            )


def _schedule(policy: int, priority: int) -> None:
    """Sets the policy of all threads; again until none has begun meanwhile with the earlier one."""
    while others := [thread for thread in _threads() if _policy(thread) not in (policy, None)]:
        for thread in others:
            try:
                os.sched_setscheduler(thread, policy, os.sched_param(priority))
            except ProcessLookupError:  # it has ended
                continue


def _threads() -> list[int]:
    return [int(task.name) for task in _THREADS.iterdir()]


def _policy(thread: int) -> int | None:
    try:
        return os.sched_getscheduler(thread)
    except ProcessLookupError:
        return None
