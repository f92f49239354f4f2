"""A listening socket that takes so many connections at once, so that no stranger takes all descriptors."""

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
        """Somebody else closes it: it counts no more."""
        listener, self.listener = self.listener, None
        if listener is not None:
            listener.closed()
        return super().detach()


class BoundedListener(socket.socket):
    """Takes the place of a socket that listens.

    Args:
        bound: it; it is this one's from now on.
        most: connections at once, whether or not they have said anything yet.
    """

    def __init__(self, bound: socket.socket, most: int) -> None:
        timeout = bound.gettimeout()
        super().__init__(bound.family, bound.type, bound.proto, fileno=bound.detach())
        self.settimeout(timeout)
        self._most: Final = most
        self._open = 0
        self._guard = threading.Lock()

    def accept(self) -> tuple[socket.socket, Any]:
        """Raises BlockingIOError: there are as many as there may be; who came is gone."""
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
        """Told by a connection."""
        with self._guard:
            self._open -= 1
