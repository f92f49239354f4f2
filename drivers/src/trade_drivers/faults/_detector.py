"""The bus thread's part: after each cycle it looks what has changed, and hands that on without waiting."""

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

from trade.errors import BusGone, DeviceError, DeviceFault, TradeError
from trade_drivers.faults._record import kind_of, parts_of

if TYPE_CHECKING:
    from trade_drivers.bus._cycle import BusDevice, BusExchange
    from trade_drivers.bus._jobs import Device

__all__ = ["BUS_GONE", "SILENT", "Found", "Lookout", "Tell", "Trouble", "found_in"]

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


class _Seen:
    """What is known of one device."""

    __slots__ = ("device", "fault", "link", "refusing")

    def __init__(self, device: "BusDevice") -> None:
        self.device = device
        self.fault = ""
        self.link = False
        self.refusing: Callable[[Device], TradeError] | None = None


class Lookout:
    """Tells of every change once; what comes and goes between two cycles was never there."""

    def __init__(self, exchange: "BusExchange[Any]", tell: Tell) -> None:
        self._exchange = exchange
        self._tell = tell
        self._seen = tuple(_Seen(device) for device in exchange.devices)

    def look(self) -> None:
        """Compare every device with what is known of it."""
        exchange = self._exchange
        now_ns, refusing, stale_ns = exchange.clock(), exchange.refusing, exchange.stale_after_ns
        for seen in self._seen:
            device = seen.device
            if (fault := device.fault) != seen.fault:
                seen.fault = fault
                self._say(device, "fault", device.faulty() if fault else None)
            if refusing is None and not device.silent and device.age_ns(now_ns) <= stale_ns:
                if seen.link:
                    seen.link, seen.refusing = False, None
                    self._say(device, "link", None)
            elif not seen.link or (refusing is not None and refusing != seen.refusing):
                seen.link, seen.refusing = (
                    True,
                    refusing,
                )  # until it is heard, it is as it was: it was not silent besides
                self._say(device, "link", device.deaf(now_ns) if refusing is None else refusing(device))

    def _say(self, device: "BusDevice", respect: Respect, error: TradeError | None) -> None:
        found = () if error is None else found_in(device.name, error)
        self._tell(Trouble(device.name, respect, time.time(), time.monotonic(), found))


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
