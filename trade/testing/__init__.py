"""Tools for tests of programs that use TRADE: a whole system in one process, and suites for implementations.

Nothing here needs a test framework; the suites are plain classes with ``test_`` methods, run in a subclass by pytest.
"""

from trade.testing._losses import LossConformance, Severable
from trade.testing._system import MemorySystem, memory_system
from trade.testing._transports import TransportConformance
from trade.testing.virtual import Deadlock, VirtualTime, VirtualTimeError, virtual_time
from trade.transport.memory import Clock, InFlightMessage, MessageKind, Network

__all__ = [
    "Clock",
    "Deadlock",
    "InFlightMessage",
    "LossConformance",
    "MemorySystem",
    "MessageKind",
    "Network",
    "Severable",
    "TransportConformance",
    "VirtualTime",
    "VirtualTimeError",
    "memory_system",
    "virtual_time",
]
