"""Protects the transport's ports against floods: with too many unlinked connections, no new one is accepted.

The transport accepts every connection at once. On a port with TLS, it ends those that fail one after the other, at ten
a second (zenoh 1.10, measured), and makes no link before that: connections that were let in for 20 s at 25 a second
delay links by half a minute. A socket filter on the listening sockets makes the kernel drop new connections meanwhile.
Existing links are not affected, and the stop line is separate. Linux only.

A connection that stays without being a link is ended. The transport ends those that it does not link, after four
seconds. But it may lose count of a link that stays open (zenoh 1.10, if both ends dialled): nothing is sent on it, and
the other end refuses every new link until this one ends.
"""

import contextlib
import ctypes
import ipaddress
import logging
import math
import os
import select
import socket
import struct
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

from trade.transport.endpoints import Endpoint

_logger = logging.getLogger("trade")

MOST_STRANGERS: Final = 128
MOST_WITH_TLS: Final = 24
"""What the transport ends within 2.4 s."""
_LOOK_S: Final = 0.25
_AGAIN_S: Final = 0.02
"""The time between two looks while connections arrive."""
_STRAY_S: Final = 6.0
"""A connection that is no link for this long is ended. The transport ends those that it does not link after four."""
_QUIET_S: Final = 10.0
"""A flood is over after this time without too many strangers."""
_CONNECTIONS: Final = (Path("/proc/self/net/tcp"), Path("/proc/self/net/tcp6"))
_OPEN_FILES: Final = Path("/proc/self/fd")
_POSSIBLE: Final = sys.platform == "linux" and _OPEN_FILES.is_dir()
_OPEN: Final = ("01", "08")
"""Established; and hung up by the other end, but not ended here."""
_SO_ATTACH_FILTER: Final = 26
_SO_DETACH_FILTER: Final = 27
_DROP_ALL: Final = ctypes.create_string_buffer(struct.pack("HBBI", 0x06, 0, 0, 0))
"""A Linux socket filter of one instruction: drop the packet."""


class _End(NamedTuple):
    """One end of a connection."""

    address: str
    port: int


class PortGuard:
    """Watches the ports that this process's transport listens on, until it is closed.

    Args:
        ports: the ports to watch.
        links: returns the number of links.
        far_ends: returns the endpoints of the far ends of all links; None: not now.
        most: the largest number of connections that are not links.
    """

    def __init__(
        self,
        ports: Iterable[int],
        links: Callable[[], int],
        far_ends: Callable[[], Iterable[str] | None],
        most: int = MOST_STRANGERS,
    ) -> None:
        self._ports = frozenset(ports)
        self._links = links
        self._far_ends = far_ends
        self._limit = most
        self._sockets = own_sockets(partial(_is_guarded, ports=self._ports)) if _POSSIBLE else []
        self._shut = frozenset[int]()
        """The sockets that accept no new connection now, by their places."""
        self._flood: _Flood | None = None
        self._known = frozenset[tuple[str, str]]()
        """The connections at the last look: the far end and ours, as ``address:port`` in the kernel's words."""
        self._strays: dict[_End, float] = {}
        """Since when connections have been no links, by their far ends, as far as looks have shown."""
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
            crowded, strays_at = True, 0.0  # some may have come before this thread began
            while not self._ending.is_set():
                arrived, now = bool(arrivals.poll(_LOOK_S)), time.monotonic()
                if now >= strays_at:
                    strays_at = now + _STRAY_S if self._end_strays(now) else math.inf
                if arrived or crowded:  # few strangers become many only by arrivals
                    strays_at = min(strays_at, now + _STRAY_S)
                    crowded = self._look(now)
                    self._ending.wait(_AGAIN_S)
        self._filter(frozenset())

    def _end_strays(self, now: float) -> bool:
        """Ends connections that have not been links for too long; returns whether others may become such."""
        try:
            there, far_ends = _connections(self._ports), self._far_ends()
        except OSError as bad:
            _logger.debug("the ports of the transport cannot be inspected: %s", bad)
            return True
        if far_ends is None:
            return True
        linked = {_from_endpoint(endpoint) for endpoint in far_ends}
        strays = {_from_kernel(far): _from_kernel(own) for far, own in there}
        self._strays = {far: self._strays.get(far, now) for far in strays if far not in linked}
        old = {(far, strays[far]) for far, since in self._strays.items() if now - since >= _STRAY_S}
        if old and (ended := _ended(old)):
            ports = ", ".join(map(str, sorted(self._ports)))
            _logger.warning("%d connections at port %s were no links for %g s, and were ended", ended, ports, _STRAY_S)
        return bool(self._strays)

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


def own_sockets(chosen: Callable[[socket.socket], bool]) -> list[socket.socket]:
    """Copies of the sockets of this process that are chosen; the caller closes them. Linux only."""
    found: dict[int, socket.socket] = {}
    for file in list(_OPEN_FILES.iterdir()):
        with contextlib.ExitStack() as unless_chosen, contextlib.suppress(OSError, ValueError):
            if int(file.name) in found or not str(file.readlink()).startswith("socket:"):
                continue  # a copy may have the number of the file that listed the others
            copy = unless_chosen.enter_context(socket.socket(fileno=os.dup(int(file.name))))
            if chosen(copy):
                found[copy.fileno()] = copy
                unless_chosen.pop_all()
    return list(found.values())


def _is_guarded(sock: socket.socket, ports: frozenset[int]) -> bool:
    if not _is_tcp(sock):
        return False
    return bool(sock.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN)) and sock.getsockname()[1] in ports


def _is_tcp(sock: socket.socket) -> bool:
    return sock.family in (socket.AF_INET, socket.AF_INET6) and sock.type == socket.SOCK_STREAM


def _ended(connections: Collection[tuple[_End, _End]]) -> int:
    """Ends those of these connections that belong to this process, by their far ends and ours; returns how many."""

    def is_one(sock: socket.socket) -> bool:
        return _is_tcp(sock) and (_end(*sock.getpeername()[:2]), _end(*sock.getsockname()[:2])) in connections

    ended = own_sockets(is_one)
    for sock in ended:
        with sock, contextlib.suppress(OSError):  # its other end has just ended it
            sock.shutdown(socket.SHUT_RDWR)
    return len(ended)


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


def _end(address: str, port: int) -> _End:
    return _End(address.partition("%")[0].removeprefix("::ffff:"), port)


def _from_endpoint(text: str) -> _End:
    endpoint = Endpoint.read(text)
    return _end(endpoint.host.strip("[]"), endpoint.port)


def _from_kernel(end: str) -> _End:
    address, _, port = end.partition(":")
    return _End(_address(address), int(port, 16))


def _address(kernels: str) -> str:
    """An address as people write it."""
    raw = bytes.fromhex(kernels)
    words = b"".join(raw[first : first + 4][::-1] for first in range(0, len(raw), 4))
    return socket.inet_ntop(socket.AF_INET6 if len(words) > 4 else socket.AF_INET, words).removeprefix("::ffff:")
