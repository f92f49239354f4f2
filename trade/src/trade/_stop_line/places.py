"""The places of the stop line: a Unix socket for this user on this host, a TLS port beside each network endpoint."""

import contextlib
import os
import secrets
import socket
import ssl
import struct
from collections.abc import Generator
from pathlib import Path
from typing import Final, NamedTuple

from trade._paths import runtime_folder
from trade._security.certificates import line_context
from trade._settings import Settings
from trade._transport.endpoints import Endpoint
from trade.errors import ConfigurationError

_PORTS_BEYOND: Final = 1000
_LAST_PORT: Final = 65535
_BACKLOG: Final = 1024
_MARK: Final = ".stop-"
_OPEN_FILES: Final = Path("/proc/self/fd")
_HAS_UNIX: Final = hasattr(socket, "AF_UNIX")


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
        if self.path is not None:
            return _dialled(self.path, limit_s)
        assert self.endpoint is not None and self.context is not None  # noqa: S101 - one or the other
        host = self.endpoint.host
        plain = socket.create_connection((host, line_port(self.endpoint.port)), timeout=limit_s)
        try:
            return self.context.wrap_socket(plain, server_hostname=host)
        except BaseException:
            plain.close()
            raise


def places(settings: Settings) -> list[Place]:
    """The stop lines of this system's containers: those of this user on this host, and those it connects to."""
    found = [Place(path.name, path=path) for path in _sockets(settings.system)]
    certificate = settings.certificate()
    if certificate is not None:
        context = line_context(certificate, server=False)
        ends = map(Endpoint.read, settings.connect)
        found += [Place(str(end), endpoint=end, context=context) for end in ends if end.protocol == "tls"]
    return found


def _sockets(system: str) -> list[Path]:
    """The sockets of living containers; removes those of ended processes."""
    if not _HAS_UNIX:
        return []
    living: list[Path] = []
    with contextlib.suppress(OSError, ConfigurationError):
        for path in sorted((runtime_folder() / system).glob(f"{_MARK}*")):
            process = path.name.removeprefix(_MARK).partition("-")[0]
            if process.isdigit() and not _lives(int(process)):
                path.unlink(missing_ok=True)
            else:
                living.append(path)
    return living


def _lives(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:
        return True
    return True


@contextlib.contextmanager
def _short(path: Path) -> Generator[str]:
    """A name for the path that fits into a socket address, which has at most 108 bytes."""
    if not _OPEN_FILES.is_dir():
        yield str(path)
        return
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        yield f"{_OPEN_FILES}/{folder}/{path.name}"
    finally:
        os.close(folder)


def _dialled(path: Path, limit_s: float) -> socket.socket:
    dialling = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        dialling.settimeout(limit_s)
        with _short(path) as name:
            dialling.connect(name)
    except BaseException:
        dialling.close()
        raise
    return dialling


def host_socket(system: str) -> tuple[socket.socket, Path] | None:
    """The listening socket for this user on this host; None without Unix sockets. Raises OSError."""
    if not _HAS_UNIX:
        return None
    path = runtime_folder() / system / f"{_MARK}{os.getpid()}-{secrets.token_hex(4)}"
    path.parent.mkdir(mode=0o700, exist_ok=True)
    server = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        with _short(path) as name:
            server.bind(name)
        path.chmod(0o600)
        server.listen(_BACKLOG)
    except BaseException:
        server.close()
        raise
    return server, path


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


def is_own_user(caller: socket.socket) -> bool:
    """Whether this user, or root, is at the other end of a Unix socket, as far as the operating system knows."""
    if not hasattr(socket, "SO_PEERCRED"):
        return True  # only the folder's permissions protect it
    _, user, _ = struct.unpack("3i", caller.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i")))
    return user in (0, os.getuid())
