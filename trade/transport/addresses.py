"""Tries the addresses of a listener side by side, and keeps what came of each.

Only addresses that accept a connection are given to the transport, which would try them one after the other, each for
seconds. Names are resolved at each try, to all of their addresses.
"""

import errno
import os
import selectors
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Final, NamedTuple, Protocol

from trade.transport.endpoints import Endpoint

_LIMIT_S: Final = 1.5
"""A SYN that was lost is repeated after 1 s."""
_MOST_KEPT: Final = 256
_TIMED_OUT: Final = "timed out"
ACCEPTS: Final = "accepts connections"
"""What a problem of a link begins with that was not made although a connection was."""
_UNRESOLVED: Final = "the name has no address now"


class Attempt(NamedTuple):
    """The last try at one address."""

    address: str
    """Its endpoint: ``tcp/10.9.0.5:7450``, or the name that has no address."""
    problem: str
    """What is known: what the kernel or the other side said, or that nothing was said in time. Empty: it accepted."""
    ago_s: float
    """How long ago that was."""

    @property
    def accepted(self) -> bool:
        """Whether it accepted a connection, even if no link was made."""
        return not self.problem or self.problem.startswith(ACCEPTS)

    def __str__(self) -> str:
        """``10.9.0.5:7450 (refused)``."""
        return f"{self.address.partition('/')[2] or self.address} ({self.problem or ACCEPTS})"


class Knock(Protocol):
    """Connects to several endpoints at once; yields each with its problem, in the order of the answers."""

    def __call__(self, endpoints: Sequence[Endpoint], limit_s: float) -> Iterator[tuple[Endpoint, str]]: ...


class Attempts:
    """Tries addresses, and keeps the last attempt at each; thread-safe.

    Args:
        is_near: whether a host's address is in a network of this host; those are tried first.
        resolve: the endpoints of all current addresses of a host.
        knocks: connects to several at once.
    """

    def __init__(
        self,
        is_near: Callable[[str], bool] = lambda _: False,
        resolve: Callable[[Endpoint], list[str]] = Endpoint.resolved,
        knocks: Knock | None = None,
    ) -> None:
        self._is_near = is_near
        self._resolve = resolve
        self._knock = knock if knocks is None else knocks
        self._guard = threading.Lock()
        self._last: dict[str, tuple[str, float]] = {}

    def accepting(self, endpoints: Sequence[str]) -> Iterator[str]:
        """Try all addresses of these endpoints at once; yields those that accept, as they answer.

        Own networks come first, and what failed at the last try comes last. Endpoints that only the transport can try
        (UDP, or with settings after ``?`` or ``#``) are yielded as they are, after the others. So is a name with TLS,
        in place of its addresses: the certificate may be for the name.
        """
        plain: dict[str, str] = {}
        others: list[str] = []
        for text in endpoints:
            asked = Endpoint.read(text)
            if asked.protocol not in ("tcp", "tls", "ws") or asked.rest:
                others.append(text)
                continue
            found = self._resolve(asked)
            if not found:
                self.note(text, _UNRESOLVED)
            elif text not in found:
                self._forget(text)
            plain |= dict.fromkeys(found, text if asked.protocol == "tls" else "")
        wanted = [Endpoint.read(text) for text in sorted(plain, key=self._rank)]
        for endpoint, problem in self._knock(wanted, _LIMIT_S) if wanted else ():
            self.note(str(endpoint), problem)
            if not problem:
                yield plain[str(endpoint)] or str(endpoint)
        yield from others

    def _rank(self, endpoint: str) -> tuple[bool, bool]:
        failed = bool(self._last.get(endpoint, ("", 0.0))[0])
        return failed, not self._is_near(Endpoint.read(endpoint).host.strip("[]"))

    def note(self, endpoint: str, problem: str) -> None:
        """Keep what came of a try; empty: it succeeded."""
        with self._guard:
            self._last.pop(endpoint, None)
            self._last[endpoint] = problem, time.monotonic()
            while len(self._last) > _MOST_KEPT:
                del self._last[next(iter(self._last))]

    def _forget(self, name: str) -> None:
        with self._guard:
            self._last.pop(name, None)

    def listed(self) -> list[Attempt]:
        """The last attempt at each address, oldest first."""
        now = time.monotonic()
        with self._guard:
            return [Attempt(address, problem, now - at) for address, (problem, at) in self._last.items()]


def knock(endpoints: Sequence[Endpoint], limit_s: float) -> Iterator[tuple[Endpoint, str]]:
    """Connect to all at once, without waiting for one before the next, and hang up; see ``Knock``."""
    until = time.monotonic() + limit_s
    with selectors.DefaultSelector() as selector:
        waiting: dict[int, socket.socket] = {}
        try:
            for endpoint in endpoints:
                host = endpoint.host.strip("[]")
                sock = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM)
                sock.setblocking(False)
                error_number = sock.connect_ex((host, endpoint.port))
                if error_number in (0, errno.EINPROGRESS, errno.EWOULDBLOCK):
                    waiting[sock.fileno()] = sock
                    selector.register(sock, selectors.EVENT_WRITE, endpoint)
                else:
                    sock.close()
                    yield endpoint, _problem(error_number)
            while waiting and (left_s := until - time.monotonic()) > 0:
                for key, _ in selector.select(left_s):
                    sock = waiting.pop(key.fd)
                    selector.unregister(sock)
                    error_number = sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
                    sock.close()
                    yield key.data, _problem(error_number)
            for descriptor in list(waiting):
                yield selector.get_key(descriptor).data, _TIMED_OUT
        finally:
            for sock in waiting.values():
                sock.close()


def _problem(error_number: int) -> str:
    return {0: "", errno.ECONNREFUSED: "refused", errno.ETIMEDOUT: _TIMED_OUT}.get(error_number) or (
        os.strerror(error_number).lower() if error_number else ""
    )
