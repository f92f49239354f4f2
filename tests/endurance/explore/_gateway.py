"""A gateway of stories: a container in each of two systems in memory, and the border between them."""

import contextlib

from tests.support.two_systems import member
from trade import Container, errors
from trade.sharing import Border
from trade.testing import MemorySystem

DOOR = "gateway"
PUBLIC = "public"


class Gateway:
    """Offers the robots of a system in another one, whose clients it serves."""

    def __init__(self, robots: MemorySystem, clients: MemorySystem) -> None:
        self.robots, self.clients = robots, clients
        self._border: Border | None = None

    def client(self, name: str) -> Container:
        """The container of a client on the public side, started if it does not run."""
        node = self.clients.network.node(name)
        if node is not None and not node.closed:
            return self.clients.container(name)
        return member(self.clients, name, PUBLIC, name)

    def start(self) -> None:
        """A new boot of it."""
        self._border = Border(self.robots.container(DOOR), self.client(DOOR), exported=["rosie"])

    def kill(self) -> None:
        """Both containers end as a process does; what is left of its threads ends, too."""
        self.robots.kill(DOOR)
        self.clients.kill(DOOR)
        self.close()

    def close(self) -> None:
        if self._border is not None:
            with contextlib.suppress(errors.TradeError):
                self._border.close()
            self._border = None
