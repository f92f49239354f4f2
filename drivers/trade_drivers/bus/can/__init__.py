"""CAN buses through python-can: a port for one thread, with load, error state and reconnection."""

from trade_drivers.bus.can._bus_load import LoadMeter, frame_bits
from trade_drivers.bus.can._errors import ErrorState, error_state
from trade_drivers.bus.can._listeners import Listeners
from trade_drivers.bus.can._netlink import Link, look_at
from trade_drivers.bus.can._port import CanPort, Frame, split_port
from trade_drivers.bus.can._sniffer import FramesById

__all__ = [
    "CanPort",
    "ErrorState",
    "Frame",
    "FramesById",
    "Link",
    "Listeners",
    "LoadMeter",
    "error_state",
    "frame_bits",
    "look_at",
    "split_port",
]
