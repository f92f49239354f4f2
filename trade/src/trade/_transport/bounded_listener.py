"""A listening socket with a limit on its connections, so that strangers cannot exhaust all file descriptors."""

import socket
import threading
from typing import Any, Final


class _Counted(socket.socket):
    """A connection that is counted until it is closed."""

    listener: "BoundedListener | None" = None

    def close(self) -> None:
        """Idempotent."""
        listener, self.listener = self.listener, None
        if listener is not None:
            listener.closed()
        super().close()

    def detach(self) -> int:
        """Another object closes the socket: it is no longer counted."""
        listener, self.listener = self.listener, None
        if listener is not None:
            listener.closed()
        return super().detach()


class BoundedListener(socket.socket):
    """A listening socket that limits its connections.

    Args:
        bound: the socket to replace; this object takes its descriptor.
        most: the largest number of connections at once, whether or not they have sent anything yet.
    """

    def __init__(self, bound: socket.socket, most: int) -> None:
        timeout = bound.gettimeout()
        super().__init__(bound.family, bound.type, bound.proto, fileno=bound.detach())
        self.settimeout(timeout)
        self._most: Final = most
        self._open = 0
        self._guard = threading.Lock()

    def accept(self) -> tuple[socket.socket, Any]:
        """Raises BlockingIOError: the limit is reached; the new connection was closed."""
        plain, address = super().accept()
        made = _Counted(plain.family, plain.type, plain.proto, fileno=plain.detach())
        with self._guard:
            taken = self._open < self._most
            self._open += taken
        if not taken:
            made.close()
            raise BlockingIOError
        made.listener = self
        return made, address

    def closed(self) -> None:
        """Called by a connection when it closes."""
        with self._guard:
            self._open -= 1
