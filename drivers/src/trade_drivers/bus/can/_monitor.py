"""A CAN bus as others see it: a service that tells how it is."""

from collections.abc import Callable
from typing import Literal

from msgspec import Struct

from trade import service
from trade_drivers.faults._health import HEALTHY

__all__ = ["CanBusState", "CanMonitor", "ErrorWord"]

ErrorWord = Literal["error-active", "error-warning", "error-passive", "bus-off"]


class CanBusState(Struct, frozen=True, kw_only=True):
    """How a CAN bus is, seen from the driver's end of it."""

    name: str
    """The bus, such as ``rosie.bus.legs``."""
    port: str
    """Such as ``socketcan:can0``."""
    up: bool
    """False: it is unplugged, down or off the bus; the driver tries to open it again."""
    state: ErrorWord
    """Of this end's controller: as its system told when it was opened, then as error frames tell."""
    load: float
    """Share of the bit rate that frames took in the last second, 0 to 1, stuffed bits reckoned at their most."""
    error_frames: int
    """Received since the driver was attached."""
    bus_offs: int
    """How often it went bus-off since then."""


class CanMonitor:
    """A CAN bus, to look at. Asking puts nothing on it."""

    def __init__(self, look: Callable[[], CanBusState]) -> None:
        self._look = look

    @service(effect="read")
    def bus_state(self) -> CanBusState:
        """Error state, load, error frames and bus-offs of the bus; also while it is gone."""
        return self._look()

    def health(self) -> str:
        """What is wrong with everything on this bus, as the registry says it."""
        state = self._look()
        if state.state in {"error-passive", "bus-off"}:
            return f"degraded: CAN {state.state}"
        return HEALTHY if state.up else "degraded: CAN bus gone"
