"""Changes of a device's faults, as fault detectors report them."""

from collections.abc import Callable
from typing import Final, Literal, NamedTuple

from trade.errors import BusGone, DeviceError, DeviceFault
from trade_drivers.faults._record import kind_of, parts_of

SILENT: Final = "silent"
BUS_GONE: Final = "bus gone"
Respect = Literal["fault", "link"]


class FaultUpdate(NamedTuple):
    """The faults of a device in one respect from now on; replaces the previous ones."""

    device: str
    respect: "Respect"
    """The device's own report, or its connection; both can fail at once."""
    at: float
    """Seconds since the epoch."""
    at_s: float
    """``time.monotonic()``."""
    found: "tuple[DetectedFault, ...]" = ()
    """All current faults in this respect; empty if there are none."""


class DetectedFault(NamedTuple):
    """One fault."""

    kind: str
    text: str
    remedy: str = ""


Tell = Callable[[FaultUpdate], object]
"""Accepts a change; never waits."""


def found_in(device: str, error: Exception) -> tuple[DetectedFault, ...]:
    """Returns the faults of a device that an error describes."""
    match error:
        case DeviceFault():
            parts = parts_of(error.fault)
            return tuple(DetectedFault(kind_of(part), f"{device}: {part}", error.remedy) for part in parts)
        case BusGone():
            return (DetectedFault(BUS_GONE, str(error)),)
        case DeviceError():
            return (DetectedFault(SILENT, str(error)),)
        case _:  # a bug in the driver
            return (DetectedFault(type(error).__name__, f"{device}: its state cannot be read: {error!r}"),)
