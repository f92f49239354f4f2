"""What services ask of the thread that owns a bus: work that is waited for, and what lets a command pass."""

import threading
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final, Generic, Protocol, TypeVar

from trade import current_call
from trade.errors import DeadlineExceeded, DeviceFault, TradeError

if TYPE_CHECKING:
    from trade_drivers.bus._cycle import BusCycle
    from trade_drivers.bus._deadlines import Terms

__all__ = [
    "TAKEN",
    "BadAnswer",
    "Command",
    "Device",
    "Gate",
    "NoAnswer",
    "PortLost",
    "PortOpening",
    "Refused",
    "Steps",
    "WireError",
    "Work",
    "losing",
]

Steps = Generator[None, None, None]
"""Yields after each exchange on the wire, so that stops and cycles come in between."""

Gate = Callable[[], None]
"""Called right before the bytes go out; what it raises keeps them in."""

TAKEN: Final = "another driver owns this port"
"""What is said of a port that somebody else has."""

_TELL_S: Final = 0.1


class PortLost(Exception):
    """The port itself is gone: unplugged, down, or never opened."""


class PortOpening(PortLost):
    """It is about to be opened, which takes a while: ask again soon."""


@contextmanager
def losing(*troubles: type[Exception]) -> Generator[None, None, None]:
    """Have these, which a library raises when its port is gone, become ``PortLost``."""
    try:
        yield
    except TradeError:  # a gate's: some of them are OSErrors, too
        raise
    except troubles as gone:
        raise PortLost(str(gone)) from None


class WireError(Exception):
    """An exchange with a device failed."""


class NoAnswer(WireError):
    """Nothing came within the time that was whole and belonged to the question."""

    def __init__(self, device_id: int, waited_s: float) -> None:
        super().__init__(f"id {device_id} did not answer within {waited_s * 1e3:.0f} ms")
        self.device_id = device_id
        self.waited_s = waited_s


class BadAnswer(NoAnswer):
    """Something came, but it was damaged or cut short."""


class Refused(WireError):
    """The device answered that it would not, and why."""

    def __init__(self, device_id: int, reason: str) -> None:
        super().__init__(reason)
        self.device_id = device_id


class Device(Protocol):
    """Something on a bus, as errors tell of it."""

    @property
    def name(self) -> str:
        """Such as ``rosie.neck.pan``."""
        ...

    def faulty(self, fault: str = "") -> DeviceFault:
        """The error of a device with a fault; by default the latched one."""
        ...


_Device_co = TypeVar("_Device_co", bound=Device, covariant=True)
_Cycle_co = TypeVar("_Cycle_co", bound="BusCycle[Any]", covariant=True)


class Work(Generic[_Device_co]):
    """Something that is waited for. As it stands it needs no leave: it ends motion."""

    def __init__(self, devices: Sequence[_Device_co]) -> None:
        self.devices = tuple(devices)
        """Those it touches, or waits for; at least one."""
        self._call = current_call()
        self._ended = threading.Event()
        self._error: TradeError | None = None
        self._steps: Steps | None = None

    @property
    def ended(self) -> bool:
        """Its outcome is known."""
        return self._ended.is_set()

    def gate(self) -> None:
        """The last look before its bytes go out; what it raises keeps them in."""

    def steps(self) -> Steps:
        """The work."""
        raise NotImplementedError

    def step(self) -> bool:
        """Do one exchange of it; False when nothing is left to do."""
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
        """Tell whoever traces the call that asked for it what has just been done, such as ``wrote goal``."""
        if self._call is not None:
            self._call.event(f"{', '.join(device.name for device in self.devices)}: {done}")

    def done_stepping(self) -> None:
        """All its exchanges have been made."""
        self.finish()

    def finish(self, error: TradeError | None = None) -> None:
        """Let the waiting service have the outcome; only the first counts."""
        if not self._ended.is_set():
            self._error = error
            self._ended.set()

    def wait(self, alive: Callable[[], bool], tell: Callable[[], None] | None = None) -> None:
        """Block until it has ended; call ``tell`` ten times a second meanwhile.

        Raises:
            TradeError: what became of it.
        """
        while not self._ended.wait(1.0 if tell is None else _TELL_S):
            if tell is not None:
                tell()
            if not alive():
                self.finish(self.devices[0].faulty("the thread of its bus has ended"))
        if self._error is not None:
            raise self._error


class Command(Work[_Device_co], Generic[_Device_co, _Cycle_co]):
    """A command that may start motion: it expires, and its call was admitted under a permit."""

    def __init__(self, exchange: _Cycle_co, devices: Sequence[_Device_co], terms: "Terms") -> None:
        super().__init__(devices)
        self._exchange = exchange
        self.service, self.expires_ns, self.until_ns, self.permit = terms
        self._admitted_ns = exchange.clock()

    @property
    def exchange(self) -> _Cycle_co:
        """The bus it is carried out on."""
        return self._exchange

    def gate(self) -> None:
        """The last look before its bytes go out.

        Raises:
            DeadlineExceeded: it is late, and late is never.
            MotionStopped, LockLost, LockedByOther: a stop, or another owner, came after it was admitted.
        """
        if self._exchange.clock() >= self.expires_ns:
            raise self.expired()
        self.permit.gate()

    def expired(self) -> DeadlineExceeded:
        """The error of a command that came too late to be carried out."""
        patience_s = max(0.0, (self.expires_ns - self._admitted_ns) / 1e9)
        return DeadlineExceeded(service=self.service, deadline_s=patience_s)
