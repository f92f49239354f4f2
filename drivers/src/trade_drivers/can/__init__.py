"""CAN buses through python-can: one port, used by one thread; its load, its errors, its loss."""

from trade_drivers.can._bench import CanBench
from trade_drivers.can._errors import ErrorState, error_state
from trade_drivers.can._listeners import Listeners
from trade_drivers.can._load import LoadMeter, frame_bits
from trade_drivers.can._netlink import Link, look_at
from trade_drivers.can._port import CanPort, Frame, split_port
from trade_drivers.can._talk import Talk

__all__ = [
    "CanBench",
    "CanPort",
    "ErrorState",
    "Frame",
    "Link",
    "Listeners",
    "LoadMeter",
    "Talk",
    "error_state",
    "frame_bits",
    "look_at",
    "split_port",
]
