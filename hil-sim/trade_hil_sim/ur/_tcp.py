"""The TCP side of a controller: its ports, and connections that send each answer when it is due."""

import socket
import time
from collections import deque
from collections.abc import Collection, Sequence
from contextlib import suppress
from typing import Final

from trade_hil_sim.faults._commands import AnswerPart
from trade_hil_sim.robot._bus_thread import listener

PORTS: Final = {"rtde": 30004, "dashboard": 29999, "script": 30003}
"""The same on every controller."""

MOST_UNSENT: Final = 65_536
"""Bytes kept for a client that does not read; beyond that it is disconnected."""
SEND_BUFFER: Final = 32_768
"""Bytes that the system buffers for a client: small, so that one that was frozen finds little old data."""
MOST_READ: Final = 65_536
MOST_HELD: Final = 1 << 20
"""The greatest length of an incomplete line, packet or program."""


class Client:
    """One TCP connection of a client.

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
        """Received bytes that are not complete yet."""
        self._waiting: deque[tuple[float, bytes]] = deque()
        self._unsent = bytearray()

    def fileno(self) -> int:
        """For poll."""
        return self.connection.fileno()

    @property
    def due(self) -> float | None:
        """When its next answer is due, on CLOCK_MONOTONIC; None if there is none."""
        return self._waiting[0][0] if self._waiting else None

    @property
    def unsent(self) -> bool:
        """Whether bytes still wait to be written."""
        return bool(self._unsent)

    def read(self) -> bool:
        """Read the available bytes; False when the client has disconnected."""
        try:
            data = self.connection.recv(MOST_READ)
        except BlockingIOError:
            return True
        except OSError:
            return False
        self.held += data
        return bool(data)

    def tell(self, pieces: Sequence[AnswerPart]) -> None:
        """Queue an answer. A late one delays those behind it: a stream keeps its order."""
        now = time.monotonic()
        for data, late_s in pieces:
            before = self._waiting[-1][0] if self._waiting else now
            self._waiting.append((max(now + late_s, before), data))

    def flush(self) -> bool:
        """Write what is due without waiting; False when the client has disconnected or does not read."""
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
        """Disconnect."""
        self.connection.close()


def listeners(host: str, lacks: Collection[str] = ()) -> dict[str, socket.socket]:
    """A listening socket for each port but those that it lacks; raises OSError when one is in use."""
    made: dict[str, socket.socket] = {}
    try:
        for name in PORTS.keys() - set(lacks):
            made[name] = listener(host, PORTS[name])
    except OSError:
        for opened in made.values():
            opened.close()
        raise
    return made
