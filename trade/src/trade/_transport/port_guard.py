"""Protects the transport's ports against floods: with too many unlinked connections, no new one is accepted.

The transport accepts every connection and ends those that fail at ten a second (zenoh 1.10, measured): at 1,000
connections a second, each would hold a descriptor for minutes. A socket filter on the listening sockets makes the
kernel drop new connections meanwhile. Existing links are not affected, and the stop line is separate. Linux only.
"""

import contextlib
import ctypes
import logging
import os
import socket
import struct
import sys
import threading
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final

_logger = logging.getLogger("trade")

MOST_STRANGERS: Final = 128
_LOOK_S: Final = 0.25
_CONNECTIONS: Final = (Path("/proc/self/net/tcp"), Path("/proc/self/net/tcp6"))
_OPEN_FILES: Final = Path("/proc/self/fd")
_ESTABLISHED: Final = "01"
_SO_ATTACH_FILTER: Final = 26
_SO_DETACH_FILTER: Final = 27
_DROP_ALL: Final = ctypes.create_string_buffer(struct.pack("HBBI", 0x06, 0, 0, 0))
"""A Linux socket filter of one instruction: drop the packet."""


class PortGuard:
    """Watches the ports that this process's transport listens on, until it is closed.

    Args:
        ports: the ports to watch.
        links: returns the number of links.
    """

    def __init__(self, ports: Iterable[int], links: Callable[[], int]) -> None:
        self._ports = frozenset(ports)
        self._links = links
        self._sockets = _listening(self._ports) if sys.platform == "linux" and _OPEN_FILES.is_dir() else []
        self._shut = False
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="trade-port-guard", daemon=True)
        if self._sockets:
            self._thread.start()

    def _run(self) -> None:
        while not self._ending.wait(_LOOK_S):
            try:
                if self._shut or _open_files() > MOST_STRANGERS:  # counting connections costs more
                    self._update(_connections(self._ports) - self._links())
            except OSError as bad:
                _logger.debug("the ports of the transport cannot be inspected: %s", bad)
        if self._shut:
            self._filter(shut=False)

    def _update(self, strangers: int) -> None:
        if not self._shut and strangers > MOST_STRANGERS:
            _logger.warning(
                "%d connections at port %s are not links: no new connection is accepted until they end. Stops and "
                "e-stops still arrive on the stop line",
                strangers,
                ", ".join(map(str, sorted(self._ports))),
            )
            self._filter(shut=True)
        elif self._shut and strangers <= MOST_STRANGERS // 2:
            self._filter(shut=False)

    def _filter(self, *, shut: bool) -> None:
        program = struct.pack("HL" if struct.calcsize("P") == 4 else "HxxxxxxQ", 1, ctypes.addressof(_DROP_ALL))
        for sock in self._sockets:
            with contextlib.suppress(OSError):  # the socket is closed
                if shut:
                    sock.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, program)
                else:
                    sock.setsockopt(socket.SOL_SOCKET, _SO_DETACH_FILTER, 0)
        self._shut = shut

    def close(self) -> None:
        """Stop watching; new connections are accepted. Idempotent."""
        self._ending.set()
        if self._thread.is_alive():
            self._thread.join(2)
        for sock in self._sockets:
            sock.close()


def _listening(ports: frozenset[int]) -> list[socket.socket]:
    """Copies of the sockets of this process that listen on one of these ports."""
    found: list[socket.socket] = []
    for file in list(_OPEN_FILES.iterdir()):
        with contextlib.suppress(OSError, ValueError):
            if not str(file.readlink()).startswith("socket:"):
                continue
            copy = socket.socket(fileno=os.dup(int(file.name)))
            if _is_guarded(copy, ports):
                found.append(copy)
            else:
                copy.close()
    return found


def _is_guarded(sock: socket.socket, ports: frozenset[int]) -> bool:
    if sock.family not in (socket.AF_INET, socket.AF_INET6) or sock.type != socket.SOCK_STREAM:
        return False
    return bool(sock.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN)) and sock.getsockname()[1] in ports


def _open_files() -> int:
    """The number of open files of this process, strangers' connections included."""
    return sum(1 for _ in os.scandir(_OPEN_FILES))


def _connections(ports: frozenset[int]) -> int:
    """The number of connections to these ports of this host."""
    ends = {f":{port:04X}" for port in ports}
    count = 0
    for path in _CONNECTIONS:
        with contextlib.suppress(FileNotFoundError), path.open(encoding="ascii") as lines:
            for line in lines:
                fields = line.split(maxsplit=4)
                count += fields[3] == _ESTABLISHED and fields[1][-5:] in ends
    return count
