"""Makes an open zenoh session dial an address of our choice.

An open session has no function for that. But it may send scouts for as long as it is open, and dials a session that
answers, if the answer has the id of the session that really listens there. So it sends its scouts to us: to one port on
the loopback interface. No scout leaves the host, and an answer says whom to dial, and where.

The session receives the answers on all interfaces (zenoh 1.10). We connect that socket to our own, so that the kernel
drops what anybody else sends (S21). Linux only: that takes the list of open files.
"""

import contextlib
import itertools
import socket
import sys
import threading
from collections.abc import Sequence
from typing import Any, Final

from trade.transport.endpoints import loopback_interface
from trade.transport.port_guard import own_sockets
from trade.transport.scouting import PEER, hello

_HERE: Final = "127.0.0.1"
_marks: Final = itertools.cycle(range(100, 250))
"""No datagram leaves this host, so the time to live is free to tell which socket is whose."""
_marking: Final = threading.Lock()


class Prompt:
    """One session's: made before it opens, and closed after it."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # zenoh binds the same for a moment
        self._socket.bind((_HERE, 0))
        self._socket.setblocking(False)
        self._asked_by: tuple[str, int] | None = None
        with _marking:
            self._mark = next(_marks)

    @classmethod
    def possible(cls, settings: dict[str, Any]) -> bool:
        """Whether a session with these settings can be prompted here."""
        return sys.platform == "linux" and settings["mode"] != "client" and bool(loopback_interface())

    def settings(self, connects: bool) -> dict[str, Any]:
        """More settings of the session: it scouts here, and dials on request.

        Without an endpoint to connect to, opening would wait half a second for answers.
        """
        return {
            "scouting/multicast/enabled": True,
            "scouting/multicast/listen": False,
            "scouting/multicast/address": "{}:{}".format(*self._socket.getsockname()),
            "scouting/multicast/interface": loopback_interface(),
            "scouting/multicast/ttl": self._mark,
            "scouting/multicast/autoconnect": {"router": ["peer"], "peer": ["router", "peer"]},
            "scouting/multicast/autoconnect_strategy": {
                "peer": {"to_router": "always", "to_peer": "always"},
                "router": {"to_peer": "always"},
            },
            **({} if connects else {"scouting/delay": 0}),
        }

    def secure(self) -> bool:
        """Let the opened session hear only us; returns whether its socket was found."""
        for copy in own_sockets(self._is_marked):
            with copy, contextlib.suppress(OSError):
                copy.connect(self._socket.getsockname())
                self._asked_by = (_HERE, copy.getsockname()[1])
        return self._asked_by is not None

    def _is_marked(self, sock: socket.socket) -> bool:
        if sock.family != socket.AF_INET or sock.type != socket.SOCK_DGRAM or sock.getsockname()[0] == _HERE:
            return False
        return sock.getsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL) == self._mark

    def dial(self, session: str, endpoints: Sequence[str], kind: int = PEER) -> bool:
        """Have the session dial another one there, once; returns whether the request was sent. Waits for nothing."""
        if self._asked_by is None:
            return False
        with contextlib.suppress(OSError):
            while True:
                self._socket.recv(64)  # its scouts
        try:
            self._socket.sendto(hello(session, endpoints, kind), self._asked_by)
        except OSError:  # it is closed
            return False
        return True

    def close(self) -> None:
        """Idempotent."""
        self._asked_by = None
        self._socket.close()
