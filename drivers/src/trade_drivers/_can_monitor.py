"""A CAN bus as others see it: a service that tells how it is, and the health of what hangs on it."""

import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Final, Literal

from msgspec import Struct

from trade import service
from trade.errors import TradeError

__all__ = ["CanBusState", "CanMonitor", "ErrorWord", "HealthTeller"]

ErrorWord = Literal["error-active", "error-warning", "error-passive", "bus-off"]
_HEALTHY: Final = "healthy"
_LOOK_EVERY_S: Final = 0.5
_END_S: Final = 5.0


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

    @property
    def health(self) -> str:
        """What is wrong with everything on this bus, as the registry says it."""
        state = self._look()
        if state.state in {"error-passive", "bus-off"}:
            return f"degraded: CAN {state.state}"
        return _HEALTHY if state.up else "degraded: CAN bus gone"


class HealthTeller:
    """A thread that passes the health of buses on to what hangs on them: never the bus's own, which has no time.

    Args:
        watched: each bus with the providers on it.
        tell: says of a provider how it is.
        name: of the thread.
    """

    def __init__(
        self, watched: Mapping[CanMonitor, Sequence[object]], tell: Callable[[object, str], object], name: str
    ) -> None:
        self._watched = watched
        self._tell = tell
        self._told: dict[object, str] = {}
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End it; more than once is fine."""
        self._closing.set()
        self._thread.join(_END_S)

    def _run(self) -> None:
        while not self._closing.wait(_LOOK_EVERY_S):
            self._look()

    def _look(self) -> None:
        said: dict[object, list[str]] = {}
        for monitor, providers in self._watched.items():
            for provider in providers:
                said.setdefault(provider, []).append(monitor.health)
        for provider, healths in said.items():
            health = next((text for text in healths if text != _HEALTHY), _HEALTHY)
            if health != self._told.get(provider, _HEALTHY):
                self._told[provider] = health
                with suppress(TradeError):  # its container has ended, or it was withdrawn
                    self._tell(provider, health)
