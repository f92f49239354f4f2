"""Scouting: the two datagrams by which a container is found, on the interfaces that the host has now.

zenoh's own scouting reads the interfaces once for each process, so it neither asks nor answers on one that comes up
later. The bytes are those of zenoh's scouting protocol, version 9: containers of all versions find each other.
"""

import contextlib
import logging
import select
import selectors
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Final

from trade.transport.interfaces import OwnAddress, own_addresses

_logger = logging.getLogger("trade")

GROUP: Final = ("224.0.0.224", 7446)
ROUTER: Final = 0
PEER: Final = 1
_VERSION: Final = 9
_SCOUT: Final = 1
_HELLO: Final = 2
_KIND: Final = 0x1F
_HAS_LOCATORS: Final = 0x20
_WANTS_PEERS: Final = 2
_ASKING: Final = bytes([_SCOUT, _VERSION, _WANTS_PEERS])
_LARGEST: Final = 1 << 16
_BEAT_S: Final = 1.0
_LOOK_S: Final = 0.02


def hello(session: str, locators: Sequence[str], kind: int = PEER) -> bytes:
    """The datagram that says where a session listens; its id is in zenoh's text form."""
    raw = bytes.fromhex(session if len(session) % 2 == 0 else f"0{session}")[::-1]
    parts = [bytes([_HELLO | _HAS_LOCATORS, _VERSION, (len(raw) - 1) << 4 | kind]), raw, _count(len(locators))]
    for locator in locators:
        parts += [_count(len(locator)), locator.encode("ascii")]
    return b"".join(parts)


def _count(number: int) -> bytes:
    """Seven bits a byte, the lowest first."""
    more = number >> 7
    return bytes([number & 0x7F | 0x80]) + _count(more) if more else bytes([number])


def read_hello(data: bytes) -> tuple[str, list[str]] | None:
    """The session's id and its locators; None for any other bytes."""
    try:
        if data[0] & _KIND != _HELLO or not data[0] & _HAS_LOCATORS or data[1] != _VERSION:
            return None
        end = 3 + (data[2] >> 4) + 1
        session = data[3:end][::-1].hex()
        many, at = _read_count(data, end)
        locators: list[str] = []
        for _ in range(many):
            size, at = _read_count(data, at)
            if at + size > len(data):
                return None
            locators.append(data[at : at + size].decode("ascii"))
            at += size
    except (IndexError, UnicodeDecodeError):
        return None
    return session.lstrip("0"), locators


def _read_count(data: bytes, at: int) -> tuple[int, int]:
    number = shift = 0
    while data[at] & 0x80:
        number |= (data[at] & 0x7F) << shift
        shift, at = shift + 7, at + 1
    return number | data[at] << shift, at + 1


def scout(for_s: float, ended: Callable[[], bool], *, here_only: bool) -> Iterator[tuple[str, list[str]]]:
    """Ask on every interface at once; yields what each listener answers within that time.

    Args:
        for_s: the time to listen.
        ended: whether to end early.
        here_only: ask on the loopback interface only (S21).
    """
    until = time.monotonic() + for_s
    with selectors.DefaultSelector() as selector, contextlib.ExitStack() as leaving:
        for own in _asked(here_only, own_addresses()):
            sock = leaving.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            with contextlib.suppress(OSError):  # the address is gone again
                sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(own.ip))
                sock.bind((own.ip, 0))
                sock.setblocking(False)
                sock.sendto(_ASKING, GROUP)
                selector.register(sock, selectors.EVENT_READ, sock)
        while time.monotonic() < until and not ended():
            for key, _ in selector.select(_LOOK_S):
                with contextlib.suppress(OSError):
                    if (found := read_hello(key.data.recv(_LARGEST))) is not None:
                        yield found


def _asked(here_only: bool, known: Sequence[OwnAddress]) -> list[OwnAddress]:
    return [own for own in known if ":" not in own.ip and own.loopback == here_only and own.multicasts]


class Beacon:
    """Answers scouts until it is closed, on the interfaces and with the addresses that the host has at that moment.

    Args:
        session: the id that it announces.
        locators: the endpoints to announce; takes the addresses of this host now.
        here_only: answer on the loopback interface only (S21).
    """

    def __init__(
        self,
        session: str,
        locators: Callable[[list[OwnAddress], str], list[str]],
        *,
        here_only: bool,
    ) -> None:
        self._session = session
        self._locators = locators
        self._here_only = here_only
        self._joined: set[tuple[str, int]] = set()
        self._known = own_addresses()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._socket.bind(GROUP)
        self._socket.setblocking(False)
        self._join()
        self._ending = threading.Event()
        self._woken, self._waker = socket.socketpair()
        self._thread = threading.Thread(target=self._run, name="trade-beacon", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        look_at = time.monotonic() + _BEAT_S
        while not self._ending.is_set():
            try:
                select.select([self._socket, self._woken], [], [], max(0.0, look_at - time.monotonic()))
                if time.monotonic() >= look_at:
                    look_at = time.monotonic() + _BEAT_S
                    self._look()
                self._answer()
            except BlockingIOError:
                continue
            except OSError as bad:  # a network that just went away
                _logger.debug("a scout was not answered: %s", bad)

    def _answer(self) -> None:
        data, source = self._socket.recvfrom(_LARGEST)
        if len(data) >= len(_ASKING) and data[0] & _KIND == _SCOUT and data[2] & _WANTS_PEERS:
            self._socket.sendto(hello(self._session, self._locators(own_addresses(), source[0])), source)

    def _look(self) -> None:
        self._known = own_addresses()
        self._join()

    def _join(self) -> None:
        """The group on each interface that has an address; the kernel forgets those that went."""
        there = {(own.ip, own.interface) for own in _asked(self._here_only, self._known)}
        for ip, interface in there - self._joined:
            with contextlib.suppress(OSError):  # joined already, with another address of that interface
                wanted = socket.inet_aton(GROUP[0]) + socket.inet_aton(ip) + struct.pack("@i", interface)
                self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, wanted)
        self._joined = there

    def close(self) -> None:
        """Idempotent."""
        self._ending.set()
        self._waker.close()
        self._thread.join(_BEAT_S)
        self._woken.close()
        self._socket.close()
