"""Unix sockets in the folder of a system: for containers of one user on one host."""

import contextlib
import logging
import os
import secrets
import socket
import struct
from collections.abc import Generator
from pathlib import Path
from typing import Final

from trade._paths import runtime_folders

_logger = logging.getLogger("trade")
_BACKLOG: Final = 1024
_OPEN_FILES: Final = Path("/proc/self/fd")
_HAS_UNIX: Final = hasattr(socket, "AF_UNIX")


def listen_on_host(system: str, mark: str, name: str = "") -> tuple[socket.socket, Path] | None:
    """A listening socket for this user on this host; None without Unix sockets.

    Args:
        system: the system whose folder it is in.
        mark: the first part of the file's name, which says what it is for.
        name: the last part; none: a random one.

    Raises:
        OSError: it cannot be opened.
        ConfigurationError: others may write in the folder.
    """
    if not _HAS_UNIX:
        return None
    folders = runtime_folders()
    for folder in folders:
        path = folder / system / f"{mark}{os.getpid()}-{name or secrets.token_hex(4)}"
        try:
            return _listening(path), path
        except OSError as bad:  # such as a full file system
            if folder is folders[-1]:
                raise
            _logger.warning("%s cannot be made: %s. It is made in another folder", path, bad)
    return None


def _listening(path: Path) -> socket.socket:
    path.parent.mkdir(mode=0o700, exist_ok=True)
    early = path.with_name(f".early{path.name}")
    server = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        with _short(early) as short:
            server.bind(short)
        early.chmod(0o600)
        server.listen(_BACKLOG)
        early.replace(path)  # only now: whom a socket of its name refuses has no process any more
    except BaseException:
        server.close()
        early.unlink(missing_ok=True)
        raise
    return server


def host_sockets(system: str, mark: str, name: str = "*") -> list[Path]:
    """The sockets of living containers with this mark, and this last part of the name; removes those of ended ones.

    A container lives if its socket does not refuse: a process id says nothing to another process namespace.

    Raises:
        OSError: the folder cannot be read.
        ConfigurationError: others may write in it.
    """
    living: list[Path] = []
    found = [path for folder in runtime_folders() for path in sorted((folder / system).glob(f"{mark}*-{name}"))]
    for path in found if _HAS_UNIX else ():
        if is_deaf(path):
            path.unlink(missing_ok=True)
        else:
            living.append(path)
    return living


def is_deaf(path: Path) -> bool:
    """Whether no process listens, in this or in another process namespace."""
    try:
        dial_on_host(path, 0.0).close()
    except (ConnectionRefusedError, FileNotFoundError):
        return True
    except OSError:  # such as too many that wait for it
        return False
    return False


def dial_on_host(path: Path, limit_s: float) -> socket.socket:
    """Connects to a listening socket. Raises OSError if no process accepts within that time (seconds)."""
    dialling = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        dialling.settimeout(limit_s)
        with _short(path) as name:
            dialling.connect(name)
    except BaseException:
        dialling.close()
        raise
    return dialling


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


def is_own_user(end: socket.socket) -> bool:
    """Whether this user, or root, is at the other end of a Unix socket, as far as the operating system knows."""
    other = _other_end(end)
    return other is None or other[1] in (0, os.getuid())  # None: only the folder's permissions protect it


def process_of(end: socket.socket) -> int:
    """The process that connected, or that listens, at the other end; 0: unknown, as in another process namespace."""
    other = _other_end(end)
    return 0 if other is None else other[0]


def _other_end(end: socket.socket) -> tuple[int, int] | None:
    """The process and the user at the other end of a Unix socket; None where the operating system does not know."""
    if not hasattr(socket, "SO_PEERCRED"):
        return None
    credentials = end.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    process, user, _ = struct.unpack("3i", credentials)
    return process, user
