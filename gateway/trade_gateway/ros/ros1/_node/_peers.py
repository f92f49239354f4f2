"""Detects which nodes are alive by an open connection to the slave API of each; its end means the node's end.

A killed process closes its sockets at once; keepalive probes detect a disconnected host within 3 s.
"""

from __future__ import annotations

import selectors
import socket
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Callable
from urllib.parse import urlparse

_CONNECT_S = 1.0
_AGAIN_S = 2.0
"""Pause between attempts at an address without an answer."""
_SHORT_S = 1.0
"""A connection that ends sooner is not retried at once."""
_LOOK_S = 0.5
_PROBES = (("TCP_KEEPIDLE", 1), ("TCP_KEEPINTVL", 1), ("TCP_KEEPCNT", 2), ("TCP_USER_TIMEOUT", 3000))


class _Held:
    def __init__(self, name: str, uri: str, sock: socket.socket) -> None:
        self.name = name
        self.uri = uri
        self.sock = sock
        self.since = time.monotonic()
        self.address = _address(sock, uri)


class Peers:
    """Nodes by name; reports each change once to a callback, with the name and whether the node is present."""

    def __init__(self, changed: Callable[[str, bool], object]) -> None:
        self._changed = changed
        self._lock = threading.Lock()
        self._held: dict[str, _Held] = {}
        self._there: set[str] = set()
        self._trying: set[str] = set()
        self._failed: dict[str, tuple[str, float]] = {}
        self._selector = selectors.DefaultSelector()
        self._pool = ThreadPoolExecutor(8, thread_name_prefix="peers")
        threading.Thread(target=self._look, name="peers", daemon=True).start()

    def uri(self, name: str) -> str | None:
        """The address of a present node."""
        with self._lock:
            held = self._held.get(name)
            return held.uri if held else None

    def seeks(self, name: str) -> bool:
        """Whether this node's address should be looked up."""
        with self._lock:
            return name not in self._held and name not in self._trying

    def at(self, name: str, uri: str) -> None:
        """Adds a node's address, as the master gave it."""
        with self._lock:
            failed, when = self._failed.get(name, ("", 0.0))
            if name in self._held or name in self._trying:
                return
            if failed == uri and time.monotonic() - when < _AGAIN_S:
                return
            self._trying.add(name)
        self._pool.submit(self._try, name, uri)

    def only(self, names: set[str]) -> None:
        """Forgets failures of nodes that the master no longer lists."""
        with self._lock:
            for name in set(self._failed) - names:
                del self._failed[name]

    def _try(self, name: str, uri: str) -> None:
        try:
            at = urlparse(uri)
            sock = _connected((at.hostname or "", at.port or 80))
        except ValueError:
            sock = None
        self._tried(name, uri, sock)

    def _try_again(self, held: _Held, wait_s: float) -> None:
        """Retries the last address, without a name lookup."""
        time.sleep(wait_s)
        self._tried(held.name, held.uri, _connected(held.address))

    def _tried(self, name: str, uri: str, sock: socket.socket | None) -> None:
        with self._lock:
            self._trying.discard(name)
            if sock is None:
                self._failed[name] = (uri, time.monotonic())
            else:
                self._held[name] = held = _Held(name, uri, sock)
                self._selector.register(sock, selectors.EVENT_READ, held)
            self._tell(name, sock is not None)

    def _tell(self, name: str, there: bool) -> None:
        if there != (name in self._there):
            (self._there.add if there else self._there.discard)(name)
            self._changed(name, there)

    def _look(self) -> None:
        while True:
            # epoll sees a new registration during the call; the timeout is for the other systems
            for key, _ in self._selector.select(_LOOK_S) if self._selector.get_map() else ():
                if _ended(key.data.sock):
                    self._lost(key.data)
            if not self._selector.get_map():
                time.sleep(0.05)

    def _lost(self, held: _Held) -> None:
        with self._lock:
            self._selector.unregister(held.sock)
            held.sock.close()
            del self._held[held.name]
            self._trying.add(held.name)
        # a server may close idle connections; an ended process refuses a new one at once
        wait_s = 0.3 if time.monotonic() - held.since < _SHORT_S else 0.0
        # not in the pool, whose threads may wait for silent addresses: a death must be reported at once
        again = threading.Thread(target=self._try_again, args=(held, wait_s), name="peers-lost", daemon=True)
        try:
            again.start()
        except RuntimeError:  # the thread limit is reached
            self._try_again(held, wait_s)


def _address(sock: socket.socket, uri: str) -> tuple[str, int]:
    """The address of the other end as a number."""
    try:
        host, port = sock.getpeername()[:2]
    except OSError:  # it has ended already
        at = urlparse(uri)
        return at.hostname or "", at.port or 80
    return host, port


def _connected(address: tuple[str, int]) -> socket.socket | None:
    try:
        sock = socket.create_connection(address, _CONNECT_S)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in _PROBES:
            if hasattr(socket, option):
                sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)
        sock.setblocking(False)
    except (OSError, ValueError):
        return None
    return sock


def _ended(sock: socket.socket) -> bool:
    try:
        return not sock.recv(4096)
    except BlockingIOError:
        return False
    except OSError:
        return True
