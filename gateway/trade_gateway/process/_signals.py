"""Signals as events, for programs that run until they are asked to end."""

import ctypes
import gc
import queue
import signal
import sys
import time
from collections.abc import Generator
from contextlib import contextmanager
from types import FrameType
from typing import Final

from trade import Container
from trade.errors import ConfigurationError

_TRIM_THRESHOLD: Final = -1
"""M_TRIM_THRESHOLD of mallopt(3)."""
_MMAP_THRESHOLD: Final = -3
"""M_MMAP_THRESHOLD of mallopt(3)."""
_KEPT_BYTES: Final = 32 << 20
"""The most that glibc allows for the second one."""


class SignalEvent:
    """An event like `threading.Event` that a signal handler can set safely.

    A handler interrupts the main thread. If that thread waits for a `threading.Event`, it may hold the event's lock,
    and `set` in the handler would deadlock: the robot would ignore the signal.
    """

    def __init__(self) -> None:
        self._set = False
        self._wake_queue = queue.SimpleQueue[None]()

    def set(self) -> None:
        """Sets the event; safe in a signal handler."""
        self._set = True
        self._wake_queue.put(None)  # the only queue that is reentrant

    def clear(self) -> None:
        """Clears the event."""
        self._set = False

    def is_set(self) -> bool:
        return self._set

    def wait(self, timeout: float | None = None) -> bool:
        """Waits until the event is set, or for a timeout; returns whether it is set."""
        until = None if timeout is None else time.monotonic() + timeout
        while not self._set:
            try:
                self._wake_queue.get(timeout=None if until is None else max(0.0, until - time.monotonic()))
            except queue.Empty:
                break
            if self._set:
                self._wake_queue.put(None)  # for other waiting threads
        return self._set


@contextmanager
def leaving() -> Generator[SignalEvent]:
    """Turns Ctrl-C and SIGTERM into an event, so that devices are shut down in order."""
    event = SignalEvent()

    def leave(_number: int, _frame: FrameType | None) -> None:
        event.set()

    before = {number: signal.signal(number, leave) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield event
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def settle() -> None:
    """Excludes all existing objects from garbage collection, and keeps freed memory; to be called after start-up.

    A full collection would visit all objects, which stops every thread of a robot's process for 50 ms. Memory that the
    process gives back costs a page fault for each 4 KiB when it is needed again: milliseconds for a picture.
    """
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "mallopt"):  # musl has none
        for option in (_TRIM_THRESHOLD, _MMAP_THRESHOLD):
            libc.mallopt(option, _KEPT_BYTES)
    gc.collect()
    gc.freeze()


def refuse_twice(container: Container, command: str) -> None:
    """Raises ConfigurationError if a container of this name is up: two would make every look-up ambiguous."""
    for other in container.containers():
        if other.name == container.name and other.epoch != container.address.epoch:
            problem = f"{other.name!r} is up already (process {other.pid} on {other.host}); stop it, or choose a --name"
            raise ConfigurationError(where=command, problem=problem)


@contextmanager
def hangups() -> Generator[SignalEvent]:
    """Turns SIGHUP into an event."""
    event = SignalEvent()

    def on_hangup(_number: int, _frame: FrameType | None) -> None:
        event.set()

    number = getattr(signal, "SIGHUP", None)
    before = None if number is None else signal.signal(number, on_hangup)
    try:
        yield event
    finally:
        if number is not None:
            signal.signal(number, before)
