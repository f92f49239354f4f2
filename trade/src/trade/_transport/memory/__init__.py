"""The transport in memory: a whole network in one process, with a clock of its own and faults on demand.

Its guarantees are those of `_transport.base`; where that leaves something open it does what zenoh does. Messages that
nothing delays arrive before ``put`` returns; the others when the network's clock is moved on. Readers are real threads
on real queues.
"""

from trade._transport.memory.clock import Clock
from trade._transport.memory.links import Kind
from trade._transport.memory.network import InFlightMessage, Network, Tap
from trade._transport.memory.transport import MemoryTransport

__all__ = ["Clock", "InFlightMessage", "Kind", "MemoryTransport", "Network", "Tap"]
