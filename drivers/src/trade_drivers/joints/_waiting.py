"""Waiting for what a joint's own frames are to say, for devices that report and are not read."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from trade_drivers.bus._jobs import Steps
from trade_drivers.joints._axis import AxisT

if TYPE_CHECKING:
    from trade_drivers.joints._cycle import Exchange

__all__ = ["next_measurement", "until"]

_CHANGE_NS: Final = 600_000_000
"""How long a device may take to go from one state to the next."""
_WAIT_S: Final = 0.001


def next_measurement(bus: "Exchange[AxisT]", axis: AxisT) -> Steps:
    """Wait for one that was asked for from now on."""
    since_ns = bus.clock()
    yield from until(bus, axis, lambda: axis.sample is not None and axis.sample.at_ns > since_ns, "it says nothing")


def until(
    bus: "Exchange[AxisT]",
    axis: AxisT,
    condition: Callable[[], bool],
    otherwise: str,
    patience_ns: int = _CHANGE_NS,
) -> Steps:
    """Wait for what the device's frames are to say; ``bus.idle`` takes them in.

    Raises:
        DeviceFault: it did not come; ``otherwise`` says what is wrong then.
        DeviceSilent: the device fell silent.
    """
    give_up_ns = bus.clock() + patience_ns
    while not condition():
        bus.require_answering(axis)
        if axis.sample is not None and axis.sample.at_ns > give_up_ns:  # what it did not say is another matter
            raise axis.faulty(otherwise)
        bus.idle(_WAIT_S)
        yield
