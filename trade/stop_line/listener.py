"""The listener of the stop line: one thread, with a limit on the number of strangers.

A stranger is a connection that has not made its request yet. It has a second for its handshake and its request. If
there are too many, the listener drops one from the address that has most, preferably one that has sent nothing.
"""

import contextlib
import logging
import selectors
import socket
import ssl
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Final

from trade._security.certificates import common_name
from trade.stop_line.messages import MOST_BYTES
from trade.transport.host_socket import is_own_user

_logger = logging.getLogger("trade")

MOST_STRANGERS: Final = 256
_REQUEST_TIMEOUT_S: Final = 1.0
_MOST_ACCEPTS: Final = 64
"""How many connections it accepts before it reads from the others again."""
_POLL_S: Final = 0.1
_WOULD_BLOCK: Final = (ssl.SSLWantReadError, ssl.SSLWantWriteError, BlockingIOError)

Serve = Callable[[socket.socket, str, bytes], None]
"""Takes over a connection, with its certificate's identity (empty on this host) and its line. Does not wait."""


class Stranger:
    """A connection that has not made its request yet."""

    __slots__ = ("address", "received", "secure", "since", "sock")

    def __init__(self, sock: socket.socket, address: str, now: float) -> None:
        self.sock = sock
        self.address = address
        self.since = now
        self.secure = not isinstance(sock, ssl.SSLSocket)
        self.received: bytes | None = None
        """None: nothing yet, not even a part of a handshake."""


class Listener:
    """Accepts connections and reads their requests until it is closed.

    Args:
        servers: the listening sockets, with the TLS context of those on a network.
        serve: takes over connections with a request.
    """

    def __init__(self, servers: Sequence[tuple[socket.socket, ssl.SSLContext | None]], serve: Serve) -> None:
        self._serve = serve
        self._strangers: dict[socket.socket, Stranger] = {}
        """The oldest first."""
        self._closing = threading.Event()
        self._selector = selectors.DefaultSelector()
        self._sockets = [server for server, _ in servers]
        for server, context in servers:
            server.setblocking(False)
            self._selector.register(server, selectors.EVENT_READ, context)
        self._wake_write, self._wake_read = socket.socketpair()
        self._selector.register(self._wake_read, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._run, name="trade-stop-line", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._closing.is_set():
            for key, _ in self._selector.select(_POLL_S if self._strangers else None):
                try:
                    self._handle_ready(key)
                except Exception:
                    _logger.exception("the stop line dropped a connection")
            self._drop_expired()
        for stranger in list(self._strangers.values()):
            self._drop(stranger)

    def _handle_ready(self, key: selectors.SelectorKey) -> None:
        sock = key.fileobj
        assert isinstance(sock, socket.socket)  # noqa: S101 - nothing else is registered
        if sock in self._strangers:
            self._read_from(self._strangers[sock])
        elif sock is not self._wake_read:
            self._accept(sock, key.data)

    def _accept(self, server: socket.socket, context: ssl.SSLContext | None) -> None:
        for _ in range(_MOST_ACCEPTS):
            try:
                sock, address = server.accept()
            except OSError:  # no more connections, or no descriptors: then slow ones are dropped soon
                return
            sock.setblocking(False)
            if context is None:
                if not is_own_user(sock):
                    sock.close()
                    continue
                stranger = Stranger(sock, "", time.monotonic())
            else:
                secure = context.wrap_socket(sock, server_side=True, do_handshake_on_connect=False)
                stranger = Stranger(secure, str(address[0]), time.monotonic())
            if len(self._strangers) >= MOST_STRANGERS:
                self._drop(self._eviction_candidate())
            self._strangers[stranger.sock] = stranger
            self._selector.register(stranger.sock, selectors.EVENT_READ)

    def _eviction_candidate(self) -> Stranger:
        """The stranger to drop if there are too many."""
        strangers = list(self._strangers.values())
        busiest, _ = Counter(stranger.address for stranger in strangers).most_common(1)[0]
        its = [stranger for stranger in strangers if stranger.address == busiest]
        return next((stranger for stranger in its if stranger.received is None), its[0])

    def _read_from(self, stranger: Stranger) -> None:
        sock = stranger.sock
        try:
            if not stranger.secure:
                assert isinstance(sock, ssl.SSLSocket)  # noqa: S101 - the others are secure from the start
                stranger.received = stranger.received or b""
                sock.do_handshake()
                stranger.secure = True
            while b"\n" not in (received := stranger.received or b""):
                more = sock.recv(MOST_BYTES)
                stranger.received = received + more
                if not more or len(stranger.received) > MOST_BYTES:
                    self._drop(stranger)
                    return
        except ssl.SSLWantWriteError:
            self._selector.modify(sock, selectors.EVENT_READ | selectors.EVENT_WRITE)
            return
        except _WOULD_BLOCK:
            self._selector.modify(sock, selectors.EVENT_READ)
            return
        except (OSError, ValueError):
            self._drop(stranger)
            return
        self._hand_over(stranger)

    def _hand_over(self, stranger: Stranger) -> None:
        sock, line = stranger.sock, (stranger.received or b"").partition(b"\n")[0]
        self._selector.unregister(sock)
        del self._strangers[sock]
        sock.setblocking(True)
        certified = common_name(sock) if isinstance(sock, ssl.SSLSocket) else ""
        if not certified and isinstance(sock, ssl.SSLSocket):  # a certificate without a name
            sock.close()
            return
        try:
            self._serve(sock, certified, line)
        except BaseException:
            sock.close()
            raise

    def _drop_expired(self) -> None:
        too_old = time.monotonic() - _REQUEST_TIMEOUT_S
        while self._strangers:
            oldest = next(iter(self._strangers.values()))
            if oldest.since > too_old:
                return
            self._drop(oldest)

    def _drop(self, stranger: Stranger) -> None:
        with contextlib.suppress(KeyError, ValueError):
            self._selector.unregister(stranger.sock)
        self._strangers.pop(stranger.sock, None)
        stranger.sock.close()

    def close(self) -> None:
        """Closes all connections. Idempotent."""
        if self._closing.is_set():
            return
        self._closing.set()
        self._wake_write.send(b"!")
        self._thread.join(2)
        for sock in (*self._sockets, self._wake_write, self._wake_read):
            sock.close()
        self._selector.close()
