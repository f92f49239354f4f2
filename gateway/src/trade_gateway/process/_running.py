"""How a program of ours stays up until it is told to leave."""

import gc
import signal
from collections.abc import Generator
from contextlib import contextmanager
from types import FrameType

from trade import Container
from trade.errors import ConfigurationError
from trade_gateway.process._signal_event import SignalEvent


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
