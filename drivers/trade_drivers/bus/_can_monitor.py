"""A service that reports the state of a CAN bus."""

from collections.abc import Callable
from typing import Literal

from msgspec import Struct

from trade import service
from trade.protocol.messages import HEALTHY

ErrorWord = Literal["error-active", "error-warning", "error-passive", "bus-off"]


class CanBusState(Struct, frozen=True, kw_only=True):
    """The state of a CAN bus at the driver's end."""

    name: str
    """The bus, such as ``rosie.bus.legs``."""
    port: str
    """The port, such as ``socketcan:can0``."""
    up: bool
    """False if the bus is unplugged, down or bus-off; the driver tries to reopen it."""
    state: ErrorWord
    """Error state of this end's controller: from the system at opening, then from error frames."""
    load: float
    """Share of the bit rate used in the last second, 0 to 1, with the maximum number of stuff bits."""
    error_frames: int
    """Error frames received since the driver was attached."""
    bus_offs: int
    """Number of bus-offs since then."""


class CanMonitor:
    """Monitors a CAN bus. Its services send nothing on the bus."""

    def __init__(self, look: Callable[[], CanBusState]) -> None:
        self._look = look

    @service(effect="read")
    def bus_state(self) -> CanBusState:
        """Returns error state, load, error frames and bus-offs of the bus, also while it is gone."""
        return self._look()

    def health(self) -> str:
        """Returns the health of all devices on this bus, as the registry shows it."""
        state = self._look()
        if state.state in {"error-passive", "bus-off"}:
            return f"degraded: CAN {state.state}"
        return HEALTHY if state.up else "degraded: CAN bus gone"
