"""Protects the transport's ports against floods: with too many unlinked connections, no new one is accepted.

The transport accepts every connection at once. On a port with TLS, it ends those that fail one after the other, at ten
a second (zenoh 1.10, measured), and makes no link before that: connections that were let in for 20 s at 25 a second
delay links by half a minute. A socket filter on the listening sockets makes the kernel drop new connections meanwhile.
Existing links are not affected, and the stop line is separate. Linux only.
"""

import contextlib
import ctypes
import ipaddress
import logging
import os
import select
import socket
import struct
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Final

_logger = logging.getLogger("trade")

MOST_STRANGERS: Final = 128
MOST_WITH_TLS: Final = 24
"""What the transport ends within 2.4 s."""
_LOOK_S: Final = 0.25
_AGAIN_S: Final = 0.02
"""The time between two looks while connections arrive."""
_QUIET_S: Final = 10.0
"""A flood is over after this time without too many strangers."""
_CONNECTIONS: Final = (Path("/proc/self/net/tcp"), Path("/proc/self/net/tcp6"))
_OPEN_FILES: Final = Path("/proc/self/fd")
_OPEN: Final = ("01", "08")
"""Established; and hung up by the other end, but not ended here."""
_SO_ATTACH_FILTER: Final = 26
_SO_DETACH_FILTER: Final = 27
_DROP_ALL: Final = ctypes.create_string_buffer(struct.pack("HBBI", 0x06, 0, 0, 0))
"""A Linux socket filter of one instruction: drop the packet."""


class PortGuard:
    """Watches the ports that this process's transport listens on, until it is closed.

    Args:
        ports: the ports to watch.
        links: returns the number of links.
        most: the largest number of connections that are not links.
    """

    def __init__(self, ports: Iterable[int], links: Callable[[], int], most: int = MOST_STRANGERS) -> None:
        self._ports = frozenset(ports)
        self._links = links
        self._limit = most
        self._sockets = _listening(self._ports) if sys.platform == "linux" and _OPEN_FILES.is_dir() else []
        self._shut = frozenset[int]()
        """The sockets that accept no new connection now, by their places."""
        self._flood: _Flood | None = None
        self._known = frozenset[tuple[str, str]]()
        """The connections at the last look: the far end and ours, as ``address:port`` in the kernel's words."""
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="trade-port-guard", daemon=True)
        for sock in self._sockets if most < MOST_STRANGERS else ():
            sock.listen(most // 2)  # between two looks, a burst fills no more of the queue
        if self._sockets:
            self._thread.start()

    def _run(self) -> None:
        with select.epoll() as arrivals:
            for sock in self._sockets:
                arrivals.register(sock, select.EPOLLIN | select.EPOLLET)
            crowded = True  # some may have come before this thread began
            while not self._ending.is_set():
                if arrivals.poll(_LOOK_S) or crowded:  # few strangers become many only by arrivals
                    crowded = self._look(time.monotonic())
                    self._ending.wait(_AGAIN_S)
        self._filter(frozenset())

    def _look(self, now: float) -> bool:
        """Returns whether so many strangers may be there, or were not long ago, that they have to be counted again."""
        try:
            there = _connections(self._ports)
        except OSError as bad:
            _logger.debug("the ports of the transport cannot be inspected: %s", bad)
            return self._flood is not None
        strangers, new, self._known = len(there) - self._links(), there - self._known, there
        if self._flood is None and strangers > self._limit // 2:
            self._flood = _Flood(now, ", ".join(map(str, sorted(self._ports))), there)
        elif self._flood is not None:
            self._flood.note(new)
        if strangers <= self._limit // 2:
            self._filter(frozenset())
        elif strangers > self._limit:
            crowded = {place for place, sock in enumerate(self._sockets) if _count(sock, there) > self._limit // 2}
            self._filter(self._shut | crowded)
        if self._flood is not None and self._flood.log_due(now, strangers, self._limit, shut=bool(self._shut)):
            self._flood = None
        return self._flood is not None

    def _filter(self, shut: frozenset[int]) -> None:
        """Shuts these sockets, and opens the others: strangers at one network do not keep new links from another."""
        program = struct.pack("HL" if struct.calcsize("P") == 4 else "HxxxxxxQ", 1, ctypes.addressof(_DROP_ALL))
        changed = self._shut ^ shut
        for place in changed:
            with contextlib.suppress(OSError):  # the socket is closed
                if place in shut:
                    self._sockets[place].setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, program)
                else:
                    self._sockets[place].setsockopt(socket.SOL_SOCKET, _SO_DETACH_FILTER, 0)
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


def _count(sock: socket.socket, there: Iterable[tuple[str, str]]) -> int:
    """The number of these connections that came in at a listening socket."""
    try:
        host, port = sock.getsockname()[:2]
    except OSError:  # it is closed
        return 0
    own_ends = [end.partition(":") for _, end in there]
    everywhere = not ipaddress.ip_address(host).packed.strip(b"\0")
    return sum(int(end, 16) == port and (everywhere or _address(address) == host) for address, _, end in own_ends)


def _connections(ports: frozenset[int]) -> frozenset[tuple[str, str]]:
    """The connections to these ports of this host: the far end and ours, in the kernel's words."""
    ends = {f":{port:04X}" for port in ports}
    found: set[tuple[str, str]] = set()
    for path in _CONNECTIONS:
        with contextlib.suppress(FileNotFoundError), path.open(encoding="ascii") as lines:
            for line in lines:
                fields = line.split(maxsplit=4)
                if fields[3] in _OPEN and fields[1][-5:] in ends:
                    found.add((fields[2], fields[1]))
    return frozenset(found)


class _Flood:
    """What is said of a flood: once when connections are refused, and once when it is over."""

    def __init__(self, now: float, ports: str, ends: Iterable[tuple[str, str]]) -> None:
        self._began = self._last = now
        self._ports = ports
        self._logged = False
        self._arrivals = Counter[str]()
        self.note(ends)

    def note(self, ends: Iterable[tuple[str, str]]) -> None:
        """These connections are new."""
        self._arrivals.update(end.partition(":")[0] for end, _ in ends)

    def log_due(self, now: float, strangers: int, most: int, *, shut: bool) -> bool:
        """Logs what is due; returns whether it is over."""
        if shut:
            self._last = now
            if not self._logged:
                self._logged = True
                _logger.warning(
                    "%d connections at port %s are not links (%s): no new connection is accepted until they end. Stops "
                    "and e-stops still arrive on the stop line",
                    strangers,
                    self._ports,
                    self._sources(now),
                )
        if strangers > most // 2:
            self._last = now
        over = now - self._last > _QUIET_S
        if over and self._logged:
            _logger.warning("connections at port %s are accepted again (%s)", self._ports, self._sources(self._last))
        return over

    def _sources(self, now: float) -> str:
        """How many were let in, how fast, and where most are from."""
        (source, count), total = self._arrivals.most_common(1)[0], self._arrivals.total()
        rate = total / max(now - self._began, _LOOK_S)
        return f"{total} were let in, {rate:.0f} a second, {count} of them from {_address(source)}"


def _address(kernels: str) -> str:
    """An address as people write it."""
    raw = bytes.fromhex(kernels)
    words = b"".join(raw[first : first + 4][::-1] for first in range(0, len(raw), 4))
    return socket.inet_ntop(socket.AF_INET6 if len(words) > 4 else socket.AF_INET, words).removeprefix("::ffff:")
