"""What is wrong with a device, and how that is told."""

from collections.abc import Callable
from typing import Final, Literal, NamedTuple

from trade.errors import BusGone, DeviceError, DeviceFault
from trade_drivers.faults._record import kind_of, parts_of

__all__ = ["BUS_GONE", "SILENT", "Found", "Tell", "Trouble", "found_in"]

SILENT: Final = "silent"
BUS_GONE: Final = "bus gone"
Respect = Literal["fault", "link"]


class Trouble(NamedTuple):
    """What is wrong with a device in one respect from now on, instead of what was before."""

    device: str
    respect: "Respect"
    """What it says of itself, or whether it can be heard: both can be wrong at once."""
    at: float
    """Seconds since the epoch."""
    at_s: float
    """``time.monotonic()``."""
    found: "tuple[Found, ...]" = ()
    """All that is wrong in this respect; nothing if it is empty."""


class Found(NamedTuple):
    """One thing that is wrong."""

    kind: str
    text: str
    remedy: str = ""


Tell = Callable[[Trouble], object]
"""Takes what was noticed; never waits."""


def found_in(device: str, error: Exception) -> tuple[Found, ...]:
    """What an error says of a device."""
    match error:
        case DeviceFault():
            parts = parts_of(error.fault)
            return tuple(Found(kind_of(part), f"{device}: {part}", error.remedy) for part in parts)
        case BusGone():
            return (Found(BUS_GONE, str(error)),)
        case DeviceError():
            return (Found(SILENT, str(error)),)
        case _:  # a mistake of the driver's
            return (Found(type(error).__name__, f"{device}: its state cannot be read: {error!r}"),)
