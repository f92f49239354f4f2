"""A listening socket with a limit on its connections, so that strangers cannot exhaust all file descriptors."""

import socket
import threading
from collections.abc import Callable
from typing import Any, Final


class _CountedConnection:
    """A connection that is counted until it is closed."""

    def __init__(self, connection: socket.socket, closed: Callable[[], None]) -> None:
        self._connection: Final = connection
        self._closed: Callable[[], None] | None = closed

    def __getattr__(self, name: str) -> Any:
        return getattr(self._connection, name)

    def close(self) -> None:
        """Idempotent."""
        self._end()
        self._connection.close()

    def detach(self) -> int:
        """Another object closes the socket: it is no longer counted."""
        self._end()
        return self._connection.detach()

    def _end(self) -> None:
        closed, self._closed = self._closed, None
        if closed is not None:
            closed()


class BoundedListener:
    """A listening socket that limits its connections. It has the attributes of the socket.

    Args:
        bound: the socket; this object closes it.
        most: the largest number of connections at once, whether or not they have sent anything yet.
    """

    def __init__(self, bound: socket.socket, most: int) -> None:
        self._bound: Final = bound
        self._limit: Final = most
        self._open = 0
        self._guard = threading.Lock()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._bound, name)

    def accept(self) -> tuple[Any, Any]:
        """Raises BlockingIOError: the limit is reached; the new connection was closed."""
        made, address = self._bound.accept()
        with self._guard:
            taken = self._open < self._limit
            self._open += taken
        if not taken:
            made.close()
            raise BlockingIOError
        return _CountedConnection(made, self._closed), address

    def _closed(self) -> None:
        with self._guard:
            self._open -= 1
