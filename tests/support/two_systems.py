"""Systems in memory with names of their own, for tests of what two of them share."""

from trade import Container, Settings
from trade.testing import MemorySystem
from trade.transport.memory import MemoryTransport


def member(system: MemorySystem, name: str, of: str, identity: str) -> Container:
    """A container of a system of that name: memory systems all have one name."""
    made = Container(
        Settings(system=of, identity=identity, container=name), transport=MemoryTransport(system.network, name)
    )
    system._containers[name] = made
    system._every.append(made)
    return made
