"""The gate of a command, checked immediately before its bytes are sent: its deadlines and its permit."""

from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final, Generic, NamedTuple, TypeVar

from trade import Permit, Resource, current_call, permit
from trade.errors import DeadlineExceeded
from trade_drivers.bus._jobs import AwaitedJob, DeviceT_co

if TYPE_CHECKING:
    from trade_drivers.bus._cycle import BusCycle

_Cycle_co = TypeVar("_Cycle_co", bound="BusCycle[Any]", covariant=True)

_DEFAULT_EXPIRY_NS: Final = 1_000_000_000
"""The longest wait of a plain Python call for its turn on the bus."""
_ANSWER_NS: Final = 100_000_000
"""The time for one exchange (48 ms at most), the hold, and the answer to the caller."""


class Terms(NamedTuple):
    """The permit and the deadlines of an admitted command."""

    service: str
    """The service that was called."""
    expires_ns: int
    """The latest time for its start."""
    until_ns: int | None
    """The time when its motion is ended."""
    permit: Permit


@contextmanager
def admitted(
    service: str, resources: Sequence[Resource], times: tuple[int, int | None]
) -> Generator[Terms, None, None]:
    """Admits a command under a permit for the resources that it moves."""
    with permit(resources) as permitted:
        yield Terms(service, *times, permitted)


def at_once(clock: Callable[[], int]) -> tuple[int, None]:
    """Returns the latest start of a command without an end."""
    return expiry(clock)[0], None


def expiry(clock: Callable[[], int]) -> tuple[int, bool]:
    """Returns the latest start, and whether the motion must also end; a plain Python call has no end."""
    call = current_call()
    if call is None or call.expires_ns is None:
        return clock() + _DEFAULT_EXPIRY_NS, False
    return call.expires_ns, True


def span(clock: Callable[[], int]) -> tuple[int, int | None]:
    """Returns the latest start of a motion with an end, and the time when it is ended.

    The end is slightly before the deadline of the call, so that the caller still learns that the motion was stopped. At
    the deadline itself, no caller would be waiting for the answer.
    """
    expires_ns, ends = expiry(clock)
    if not ends:
        return expires_ns, None
    expires_ns -= min(_ANSWER_NS, max(0, expires_ns - clock()) // 5)
    return expires_ns, expires_ns


class Command(AwaitedJob[DeviceT_co], Generic[DeviceT_co, _Cycle_co]):
    """A command that may start motion. It expires, and its call was admitted under a permit."""

    def __init__(self, exchange: _Cycle_co, devices: Sequence[DeviceT_co], terms: Terms) -> None:
        super().__init__(devices)
        self._exchange = exchange
        self.service, self.expires_ns, self.until_ns, self.permit = terms
        self._admitted_ns = exchange.clock()

    @property
    def exchange(self) -> _Cycle_co:
        """The exchange of its bus."""
        return self._exchange

    def gate(self) -> None:
        """Runs the last checks before the bytes are sent.

        Raises:
            DeadlineExceeded: the command has expired.
            MotionStopped, LockLost, LockedByOther: a stop or another lock owner voided its permit.
        """
        if self._exchange.clock() >= self.expires_ns:
            raise self.expired()
        self.permit.gate()

    def expired(self) -> DeadlineExceeded:
        """Returns the error for an expired command."""
        patience_s = max(0.0, (self.expires_ns - self._admitted_ns) / 1e9)
        return DeadlineExceeded(service=self.service, deadline_s=patience_s)
