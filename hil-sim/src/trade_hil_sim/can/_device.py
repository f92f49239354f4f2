"""What sits on a CAN bus, as far as the bus is concerned."""

from collections.abc import Callable
from typing import Protocol

from trade_hil_sim.faults import _commands as faults
from trade_hil_sim.log._byte_log import Entry
from trade_hil_sim.mechanics._truth import DeviceState

from ._frame import Frame

__all__ = ["Device"]


class Device(Protocol):
    """What sits on the bus. Everything is called from the bus's thread, with the time in seconds (monotonic)."""

    device_id: int
    joint: str
    due: float
    """When `advance` should be called next; infinity if only frames matter."""
    send: Callable[[Frame, float], None]
    """Set by the bus: sends a frame from the time given on."""
    emit: Callable[[Entry], None]
    """Set by the bus: puts a line into the log, with the bus's name filled in."""

    def hear(self, frame: Frame, t: float) -> None:
        """A frame has come; not called while it is off the bus."""
        ...

    def advance(self, t: float) -> None:
        """Do what is due by itself by time `t`; `due` is later afterwards."""
        ...

    def do(self, command: faults.Command, t: float) -> None:
        """Carry out a fault or an order; raises `SimulationError` for what it has not got."""
        ...

    def heal(self, t: float) -> None:
        """End every fault of sensors and shafts."""
        ...

    def state(self, t: float) -> DeviceState:
        """The truth about it."""
        ...
