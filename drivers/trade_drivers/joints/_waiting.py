"""Waiting for reports of a device, for devices that send frames by themselves instead of being read."""

from collections.abc import Callable
from typing import Final

from trade_drivers.bus._jobs import Steps
from trade_drivers.joints._axis import AxisT
from trade_drivers.joints._cycle import Exchange

_CHANGE_NS: Final = 600_000_000
"""The time allowed for a device's change of state."""
_WAIT_S: Final = 0.001


def next_measurement(bus: Exchange[AxisT], axis: AxisT) -> Steps:
    """Waits for a measurement requested after this call."""
    since_ns = bus.clock()
    yield from until(bus, axis, lambda: axis.sample is not None and axis.sample.at_ns > since_ns, "it says nothing")


def until(
    bus: Exchange[AxisT],
    axis: AxisT,
    condition: Callable[[], bool],
    otherwise: str,
    patience_ns: int = _CHANGE_NS,
) -> Steps:
    """Waits until the device's frames show a condition; ``bus.idle`` processes the frames.

    Raises:
        DeviceFault: the condition was not met in time; ``otherwise`` is the fault.
        DeviceSilent: the device no longer answers.
    """
    give_up_ns = bus.clock() + patience_ns
    while not condition():
        bus.require_answering(axis)
        if axis.sample is not None and axis.sample.at_ns > give_up_ns:  # it answers, but the condition is not met
            raise axis.fault_error(otherwise)
        bus.idle(_WAIT_S)
        yield
