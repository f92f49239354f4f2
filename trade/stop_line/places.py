"""The places of the stop line: a Unix socket for this user on this host, a TLS port beside each network endpoint."""

import contextlib
import socket
import ssl
from pathlib import Path
from typing import Final, NamedTuple

from trade._paths import runtime_folders
from trade._security.certificates import line_context
from trade._settings import Settings
from trade.default_system import earlier_folders
from trade.errors import ConfigurationError
from trade.transport.endpoints import Endpoint
from trade.transport.host_socket import dial_on_host, host_sockets, listen_on_host

_PORTS_BEYOND: Final = 1000
_LAST_PORT: Final = 65535
_BACKLOG: Final = 1024
_MARK: Final = ".stop-"


def line_port(port: int) -> int:
    """The port of the stop line beside a port of the transport."""
    return port + _PORTS_BEYOND if port + _PORTS_BEYOND <= _LAST_PORT else port - _PORTS_BEYOND


class Place(NamedTuple):
    """The stop line of one container."""

    name: str
    path: Path | None = None
    endpoint: Endpoint | None = None
    context: ssl.SSLContext | None = None

    def connect(self, limit_s: float) -> socket.socket:
        """Connects to it. Raises OSError if no container accepts within that time (seconds, for each step)."""
        return self.secured(self.dial(limit_s))

    def dial(self, limit_s: float) -> socket.socket:
        """The first step: a plain connection. Raises OSError."""
        if self.path is not None:
            return dial_on_host(self.path, limit_s)
        assert self.endpoint is not None  # noqa: S101 - one or the other
        return socket.create_connection((self.endpoint.host, line_port(self.endpoint.port)), timeout=limit_s)

    def secured(self, plain: socket.socket) -> socket.socket:
        """The second step: that connection with TLS, if it needs it. Closes it on failure. Raises OSError."""
        if self.endpoint is None or self.context is None:
            return plain
        try:
            return self.context.wrap_socket(plain, server_hostname=self.endpoint.host)
        except BaseException:
            plain.close()
            raise


def host_places(system: str) -> list[Place]:
    """The stop lines of a system's containers of this user on this host. Raises OSError, ConfigurationError."""
    return [Place(path.name, path=path) for path in host_sockets(system, _MARK)]


def places(settings: Settings) -> list[Place]:
    """The stop lines of this system's containers: those of this user on this host, and those it connects to."""
    found: list[Place] = []
    with contextlib.suppress(OSError, ConfigurationError):
        for system in (settings.system, *_earlier(settings)):
            found += host_places(system)
    certificate = settings.certificate()
    if certificate is not None:
        context = line_context(certificate, server=False)
        ends = map(Endpoint.read, settings.connect)
        found += [Place(str(end), endpoint=end, context=context) for end in ends if end.protocol == "tls"]
    return found


def _earlier(settings: Settings) -> list[str]:
    """The earlier names of the default system: a container that runs since then, or of an earlier release, has one."""
    if settings.explicit_system:
        return []
    names = (one.name for folder in runtime_folders() for one in earlier_folders(folder, settings.system))
    return sorted(set(names))


def host_socket(system: str) -> tuple[socket.socket, Path] | None:
    """The listening socket for this user on this host; None without Unix sockets. Raises OSError."""
    return listen_on_host(system, _MARK)


def network_socket(endpoint: Endpoint) -> socket.socket:
    """The listening socket beside that endpoint. Raises ConfigurationError if its port cannot be opened."""
    host, port = endpoint.host.strip("[]"), line_port(endpoint.port)
    server = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM)
    try:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        server.bind((host, port))
        server.listen(_BACKLOG)
    except OSError as bad:
        server.close()
        problem = (
            f"its stop line, port {port}, cannot be opened ({bad.strerror or bad}). Free that port, or listen on "
            f"another one: the stop line is {_PORTS_BEYOND} above"
        )
        raise ConfigurationError(where=f"listen {endpoint}", problem=problem) from None
    return server
