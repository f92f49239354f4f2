"""Signals as events, and how a program stays up until it is asked to leave."""

import gc
import queue
import signal
import time
from collections.abc import Generator
from contextlib import contextmanager
from types import FrameType

from trade import Container
from trade.errors import ConfigurationError


class SignalEvent:
    """Used as a `threading.Event`, which may not be set in the handler of a signal.

    A handler runs on the main thread, amid whatever that is doing. If it just waits for an event, it may have the lock
    of that event, and setting it would wait for that lock for ever: a robot that does not leave when it is told to.
    """

    def __init__(self) -> None:
        self._asked = False
        self._bell = queue.SimpleQueue[None]()

    def set(self) -> None:
        """It is asked for; from a handler, too."""
        self._asked = True
        self._bell.put(None)  # of all queues the one that a handler may put into

    def clear(self) -> None:
        """It has been done."""
        self._asked = False

    def is_set(self) -> bool:
        return self._asked

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until it is asked for, or for so many seconds; whether it is."""
        until = None if timeout is None else time.monotonic() + timeout
        while not self._asked:
            try:
                self._bell.get(timeout=None if until is None else max(0.0, until - time.monotonic()))
            except queue.Empty:
                break
            if self._asked:
                self._bell.put(None)  # for others who wait
        return self._asked


@contextmanager
def leaving() -> Generator[SignalEvent]:
    """What Ctrl-C and SIGTERM ask for, so that devices are always left in order."""
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
    """To be called once all stands: from now on garbage collections leave out what is there already.

    A full one looks through all of it, which takes 50 ms in the process of a robot, and every thread waits meanwhile.
    """
    gc.collect()
    gc.freeze()


def refuse_twice(container: Container, command: str) -> None:
    """Two containers of one name that stay up would make every look-up ambiguous."""
    for other in container.containers():
        if other.name == container.name and other.epoch != container.address.epoch:
            problem = f"{other.name!r} is up already (process {other.pid} on {other.host}); stop it, or choose a --name"
            raise ConfigurationError(where=command, problem=problem)


@contextmanager
def hangups() -> Generator[SignalEvent]:
    """What SIGHUP asks for."""
    event = SignalEvent()

    def heard(_number: int, _frame: FrameType | None) -> None:
        event.set()

    number = getattr(signal, "SIGHUP", None)
    before = None if number is None else signal.signal(number, heard)
    try:
        yield event
    finally:
        if number is not None:
            signal.signal(number, before)
