"""Jobs of services for the thread that owns a bus, and the errors of its wire."""

import threading
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from typing import ClassVar, Final, Generic, Protocol, TypeVar

from trade import current_call
from trade.errors import BusGone, DeviceFault, SendQueueFull, TradeError

Steps = Generator[None, None, None]
"""A generator that yields after each exchange, so that stops and cycles run in between."""

Gate = Callable[[], None]
"""Called immediately before the bytes are sent; an exception prevents that."""

TAKEN: Final = "another driver owns this port"
"""The message for a port that another process has locked."""
SHARED: Final = "another program has this port open"
"""The message for a port that another process reads, without a lock."""

_TELL_S: Final = 0.1


class PortLost(Exception):
    """The port is gone: unplugged, down, or never opened."""

    error: ClassVar[type[BusGone]] = BusGone
    """The error for callers."""


class PortFull(PortLost):
    """The port takes no more frames: those before are still in its send queue."""

    error = SendQueueFull


class PortOpening(PortLost):
    """The port is being opened; try again soon."""


@contextmanager
def losing(*troubles: type[Exception]) -> Generator[None, None, None]:
    """Converts a library's errors about a lost port to ``PortLost``."""
    try:
        yield
    except TradeError:  # from a gate; some of them are OSErrors, too
        raise
    except troubles as gone:
        raise PortLost(str(gone)) from None


class WireError(Exception):
    """An exchange with a device failed."""


class NoAnswer(WireError):
    """No complete answer to the request arrived in time."""

    def __init__(self, device_id: int, waited_s: float) -> None:
        super().__init__(f"id {device_id} did not answer within {waited_s * 1e3:.0f} ms")
        self.device_id = device_id
        self.waited_s = waited_s


class BadAnswer(NoAnswer):
    """The answer was damaged or incomplete."""


class RequestRefused(WireError):
    """The device refused the request, with a reason."""

    def __init__(self, device_id: int, reason: str) -> None:
        super().__init__(reason)
        self.device_id = device_id


class Device(Protocol):
    """A device on a bus, as errors name it."""

    @property
    def name(self) -> str:
        """The full name, such as ``rosie.neck.pan``."""
        ...

    def fault_error(self, fault: str = "") -> DeviceFault:
        """Returns the error for a fault; by default the latched one."""
        ...


DeviceT_co = TypeVar("DeviceT_co", bound=Device, covariant=True)


class AwaitedJob(Generic[DeviceT_co]):
    """A job with a waiting service. The base class needs no permit: it is for jobs that end motion."""

    def __init__(self, devices: Sequence[DeviceT_co]) -> None:
        self.devices = tuple(devices)
        """The devices that it accesses or waits for; at least one."""
        self._call = current_call()
        self._ended = threading.Event()
        self._error: TradeError | None = None
        self._steps: Steps | None = None

    @property
    def ended(self) -> bool:
        """Whether the outcome is known."""
        return self._ended.is_set()

    def gate(self) -> None:
        """Runs the last checks before the bytes are sent; an exception prevents that."""

    def steps(self) -> Steps:
        """Runs the job, and yields after each exchange."""
        raise NotImplementedError

    def step(self) -> bool:
        """Runs one exchange; returns False when the job is done."""
        if self._steps is None:
            self._steps = self.steps()
        try:
            next(self._steps)
        except StopIteration:
            return False
        except TradeError as problem:
            self.finish(problem)
            return False
        return True

    def note(self, done: str) -> None:
        """Adds an event such as ``wrote goal`` to the trace of the call."""
        if self._call is not None:
            self._call.event(f"{', '.join(device.name for device in self.devices)}: {done}")

    def done_stepping(self) -> None:
        """Called after the last exchange."""
        self.finish()

    def finish(self, error: TradeError | None = None) -> None:
        """Passes the outcome to the waiting service; only the first one counts."""
        if not self._ended.is_set():
            self._error = error
            self._ended.set()

    def wait(self, alive: Callable[[], bool], tell: Callable[[], None] | None = None) -> None:
        """Blocks until the job has ended; calls ``tell`` ten times a second meanwhile.

        Raises:
            TradeError: the job's error.
        """
        while not self._ended.wait(1.0 if tell is None else _TELL_S):
            if tell is not None:
                tell()
            if not alive():
                self.finish(self.devices[0].fault_error("the thread of its bus has ended"))
        if self._error is not None:
            raise self._error
