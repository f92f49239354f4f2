"""The transport in memory: a whole network in one process, with its own clock and with faults on demand.

It has the guarantees of `trade.transport.base`; where those leave something open it behaves like zenoh. Messages
without a delay arrive before ``put`` returns, the others when the network's clock advances. Readers are real threads
on real queues.
"""

from trade.transport.memory.clock import Clock
from trade.transport.memory.links import MessageKind
from trade.transport.memory.network import InFlightMessage, Network, Tap
from trade.transport.memory.transport import MemoryTransport

__all__ = ["Clock", "InFlightMessage", "MemoryTransport", "MessageKind", "Network", "Tap"]
