"""Faults of a robot's devices: detected by bus threads, kept in one log, exposed as services."""

from trade_drivers.faults._fault_poller import FaultPoller
from trade_drivers.faults._fault_update import FaultUpdate, Tell
from trade_drivers.faults._log import FaultLog
from trade_drivers.faults._record import Fault, FaultInfo, FaultSample
from trade_drivers.faults._store import FaultStore

__all__ = [
    "Fault",
    "FaultInfo",
    "FaultLog",
    "FaultPoller",
    "FaultSample",
    "FaultStore",
    "FaultUpdate",
    "Tell",
]
