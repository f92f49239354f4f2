"""The hub of a host: a file in the host folder with its endpoint, and a Unix socket there for as long as it runs.

Only programs of this user have the folder. So the socket shows that a hub of this user runs, which a listener at its
old port does not show. The file stays: the next hub listens at the same port, where attached containers look for it.
"""

import contextlib
import socket
from pathlib import Path
from typing import Final, NamedTuple

from trade._paths import runtime_folders
from trade.atomic_files import replace
from trade.errors import ConfigurationError
from trade.transport.endpoints import Endpoint
from trade.transport.host_socket import host_sockets, is_deaf, listen_on_host

_MARK: Final = ".hub-"
_NAME: Final = ".hub"


class Hub(NamedTuple):
    """A hub, as its file describes it."""

    endpoint: str
    identity: str


class HubFile:
    """The hub file of one system on this host."""

    def __init__(self, system: str) -> None:
        self._system = system
        self._places: Final = [folder / system / _NAME for folder in runtime_folders()]
        self.path: Final = self._places[0]
        self._own: tuple[socket.socket, Path] | None = None

    def claim(self) -> None:
        """Makes this process the hub, until `release` or its end; of several that try at once, at most one succeeds.

        Raises:
            ConfigurationError: another process is the hub, or this host has no Unix sockets in this folder.
        """
        where = f"hub {self.path}"
        try:
            self._own = listen_on_host(self._system, _MARK)
            own = None if self._own is None else self._own[1]
            others = [path for path in self._running() if path != own]
        except OSError as bad:
            self.release()
            raise ConfigurationError(where=where, problem=f"cannot be written: {bad.strerror}") from None
        if own is None:
            raise ConfigurationError(where=where, problem="this operating system has no Unix sockets, so no hub")
        if others:
            self.release()
            problem = f"this system has a hub on this host already (process {_process(others[0])}); end it first"
            raise ConfigurationError(where=where, problem=problem)

    def announce(self, endpoint: str, identity: str) -> None:
        """Publishes where this hub listens. Raises ConfigurationError: the file cannot be written."""
        try:
            replace(self.path, f"{endpoint}\n{identity}\n".encode("ascii"))
        except OSError as bad:
            raise ConfigurationError(where=f"hub {self.path}", problem=f"cannot be written: {bad.strerror}") from None

    def last(self) -> Hub | None:
        """The running hub or the one before; None if there was none."""
        for path in self._places:
            with contextlib.suppress(OSError, ValueError):
                endpoint, identity = path.read_text(encoding="ascii").splitlines()
                Endpoint.read(endpoint)
                return Hub(endpoint, identity)
        return None

    def running(self) -> Hub | None:
        """The running hub of this user; None if there is none."""
        hub = self.last()
        with contextlib.suppress(OSError):
            return hub if hub is not None and self._running() else None
        return None

    def _running(self) -> list[Path]:
        return [path for path in host_sockets(self._system, _MARK) if not is_deaf(path)]

    def release(self) -> None:
        """Stops being the hub. Idempotent."""
        if self._own is not None:
            own, path = self._own
            path.unlink(missing_ok=True)
            own.close()
            self._own = None


def _process(path: Path) -> str:
    return path.name.removeprefix(_MARK).partition("-")[0]
