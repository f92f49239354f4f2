"""The TCP side of a controller: its ports, and connections whose answers leave when they are due."""

import socket
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from typing import Final

from trade_hil_sim.faults._commands import Piece
from trade_hil_sim.robot._bus_thread import listener

__all__ = ["MOST_HELD", "PORTS", "Client", "listeners"]

PORTS: Final = {"rtde": 30004, "dashboard": 29999, "script": 30003}
"""The same on every controller."""

MOST_UNSENT: Final = 65_536
"""Bytes kept for a client that does not read; then it is hung up on."""
SEND_BUFFER: Final = 32_768
"""Bytes the system may keep for a client: one that lay frozen wakes to little that is old."""
MOST_READ: Final = 65_536
MOST_HELD: Final = 1 << 20
"""Bytes of a line, a packet or a program that is not whole yet; more has no end."""


class Client:
    """A connection.

    Args:
        connection: accepted.
        name: for the log.
    """

    def __init__(self, connection: socket.socket, name: str) -> None:
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        self.connection = connection
        self.name = name
        self.held = bytearray()
        """What has come in and is not whole yet."""
        self._waiting: deque[tuple[float, bytes]] = deque()
        self._unsent = bytearray()

    def fileno(self) -> int:
        """For poll."""
        return self.connection.fileno()

    @property
    def due(self) -> float | None:
        """When its next answer may leave, on CLOCK_MONOTONIC; None if there is none."""
        return self._waiting[0][0] if self._waiting else None

    @property
    def unsent(self) -> bool:
        """Whether the system did not take all of it."""
        return bool(self._unsent)

    def read(self) -> bool:
        """Take in what has come; False when it has hung up."""
        try:
            data = self.connection.recv(MOST_READ)
        except BlockingIOError:
            return True
        except OSError:
            return False
        self.held += data
        return bool(data)

    def tell(self, pieces: Sequence[Piece]) -> None:
        """Queue an answer. What is late holds up what comes after it: a stream keeps its order."""
        now = time.monotonic()
        for data, late_s in pieces:
            before = self._waiting[-1][0] if self._waiting else now
            self._waiting.append((max(now + late_s, before), data))

    def flush(self) -> bool:
        """Write what is due and can be written without waiting; False when it is gone, or does not read."""
        now = time.monotonic()
        while self._waiting and self._waiting[0][0] <= now:
            self._unsent += self._waiting.popleft()[1]
        try:
            with suppress(BlockingIOError):
                if self._unsent:
                    del self._unsent[: self.connection.send(self._unsent)]
        except OSError:
            return False
        return len(self._unsent) <= MOST_UNSENT

    def close(self) -> None:
        """Hang up."""
        self.connection.close()


def listeners(host: str) -> dict[str, socket.socket]:
    """A socket that listens on each; raises OSError when one is taken."""
    made: dict[str, socket.socket] = {}
    try:
        for name, number in PORTS.items():
            made[name] = listener(host, number)
    except OSError:
        for opened in made.values():
            opened.close()
        raise
    return made
