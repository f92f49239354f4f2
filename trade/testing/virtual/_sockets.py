"""Sockets between threads of one simulation: TCP on loopback, and names of Unix sockets."""

import errno
import itertools
import os
import socket
from collections import deque
from typing import Any, Final, cast

from trade.testing.virtual._descriptors import Descriptors
from trade.testing.virtual._scheduler import Scheduler, VirtualTimeError, WaitList

_FIRST_PORT: Final = 40_000


class Network:
    """What the sockets of one simulation share: who listens where."""

    def __init__(self, scheduler: Scheduler, files: Descriptors) -> None:
        self.scheduler: Final = scheduler
        self.files: Final = files
        self.bound: Final[dict[Any, list[Socket]]] = {}
        self.ports: Final = itertools.count(_FIRST_PORT)


class Socket:
    """As `socket.socket`, for stream sockets. Unread bytes are kept without a limit."""

    _network: Network

    def __init__(self, family: int = -1, *_: int, fileno: int | None = None, **_named: int) -> None:
        if fileno is not None or family not in (-1, socket.AF_INET, socket.AF_UNIX):
            raise VirtualTimeError(f"a socket of family {family} was opened: virtual time has TCP and Unix sockets")
        self.family: Final = socket.AF_INET if family == -1 else family
        self.type: Final = socket.SOCK_STREAM
        self.proto: Final = socket.IPPROTO_TCP if self.family == socket.AF_INET else 0
        self.peer: Socket | None = None
        self.incoming = bytearray()
        self.waiting: WaitList = deque()
        self._backlog: deque[Socket] | None = None
        self._name: Any = ("127.0.0.1", 0) if self.family == socket.AF_INET else ""
        self._timeout_s: float | None = socket.getdefaulttimeout()
        self._io_refs = 0
        """How many files of it are open, which read on after it was closed."""
        self._closed = False
        self._ended = False
        """Whether no more will come."""
        self._number = self._network.files.add(self)

    # --- for waits

    @property
    def ready(self) -> bool:
        """Whether reading or accepting returns at once."""
        return bool(self.incoming) or self._ended or self._number < 0 or bool(self._backlog)

    def fileno(self) -> int:
        return self._number

    # --- set-up

    def setblocking(self, flag: bool) -> None:
        self._timeout_s = None if flag else 0.0

    def settimeout(self, value: float | None) -> None:
        self._timeout_s = value

    def gettimeout(self) -> float | None:
        return self._timeout_s

    def setsockopt(self, *_: Any) -> None: ...

    def getsockopt(self, *_: int) -> Any:
        return 0

    def set_inheritable(self, _: bool) -> None: ...

    def getsockname(self) -> Any:
        return self._name

    def getpeername(self) -> Any:
        if self.peer is None:
            raise _error(errno.ENOTCONN)
        return self.peer._name

    def bind(self, address: Any) -> None:
        if self.family == socket.AF_INET:
            address = (address[0], address[1] or next(self._network.ports))
        holders = self._network.bound.setdefault(_place(address), [])
        if (holders and self.family == socket.AF_UNIX) or any(holder._backlog is not None for holder in holders):
            raise _error(errno.EADDRINUSE)
        holders.append(self)
        self._name = address

    def listen(self, _most: int = 128) -> None:
        if self._backlog is None:  # a second call keeps those that wait
            self._backlog = deque()

    # --- connections

    def accept(self) -> tuple["Socket", Any]:
        if self._backlog is None:
            raise _error(errno.EINVAL)
        self._wait()
        if not self._backlog:
            raise _error(errno.EBADF)
        accepted = self._backlog.popleft()
        return accepted, accepted.getpeername()

    def connect(self, address: Any) -> None:
        holders = self._network.bound.get(_place(address), [])
        found = next(((one, one._backlog) for one in holders if one._backlog is not None), None)
        if found is None:
            where = f"no thread of this test listens on {address}, and virtual time reaches no other process"
            raise ConnectionRefusedError(errno.ECONNREFUSED, f"{os.strerror(errno.ECONNREFUSED)}: {where}")
        listener, backlog = found
        other = type(self)(self.family)
        other.peer, self.peer = self, other
        other._name = listener._name
        if self.family == socket.AF_INET and not self._name[1]:
            self._name = ("127.0.0.1", next(self._network.ports))
        backlog.append(other)
        self._network.scheduler.wake_all(listener.waiting)
        self._network.scheduler.may_yield()

    def connect_ex(self, address: Any) -> int:
        try:
            self.connect(address)
        except OSError as failed:
            return failed.errno or errno.ECONNREFUSED
        return 0

    def join(self, other: "Socket") -> None:
        """Connect two sockets."""
        self.peer, other.peer = other, self

    # --- bytes

    def recv(self, size: int, flags: int = 0) -> bytes:
        self._wait()
        if self._number < 0:
            raise _error(errno.EBADF)
        data = bytes(self.incoming[:size])
        if not flags & socket.MSG_PEEK:
            del self.incoming[:size]
        return data

    def recv_into(self, buffer: Any, size: int = 0, flags: int = 0) -> int:
        data = self.recv(size or len(buffer), flags)
        memoryview(buffer).cast("B")[: len(data)] = data
        return len(data)

    def send(self, data: Any, _flags: int = 0) -> int:
        if self._number < 0:
            raise _error(errno.EBADF)
        peer = self.peer
        if peer is None:
            raise _error(errno.ENOTCONN)
        if peer._number < 0:
            raise _error(errno.EPIPE)
        peer.incoming += bytes(data)
        self._network.scheduler.wake_all(peer.waiting)
        self._network.scheduler.may_yield()
        return len(data)

    def sendall(self, data: Any, flags: int = 0) -> None:
        self.send(data, flags)

    makefile: Any = socket.socket.makefile  # in Python, over the methods here

    def _decref_socketios(self) -> None:
        self._io_refs -= 1
        if self._closed:
            self.close()

    def _wait(self) -> None:
        """Until it is ready; as long as its time-out allows."""
        scheduler = self._network.scheduler
        until_ns = None if self._timeout_s is None else scheduler.now_ns + round(self._timeout_s * 1e9)
        while not self.ready:
            if self._timeout_s == 0:
                raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
            left_s = None if until_ns is None else (until_ns - scheduler.now_ns) / 1e9
            if left_s is not None and left_s <= 0:
                raise TimeoutError("timed out")
            scheduler.wait([self.waiting], left_s)

    # --- the end

    def shutdown(self, how: int) -> None:
        if self.peer is None:
            raise _error(errno.ENOTCONN)
        if how in (socket.SHUT_WR, socket.SHUT_RDWR):
            self.peer._end()
        if how in (socket.SHUT_RD, socket.SHUT_RDWR):
            self._end()

    def close(self) -> None:
        self._closed = True
        if self._number < 0 or self._io_refs > 0:
            return
        self._network.files.forget(self._number)
        self._number = -1
        holders = self._network.bound.get(_place(self._name), [])
        if self in holders:
            holders.remove(self)
        for waiting in self._backlog or ():
            waiting.close()
        self._backlog = None
        if self.peer is not None:
            self.peer._end()
        self._network.scheduler.wake_all(self.waiting)

    def _end(self) -> None:
        self._ended = True
        self._network.scheduler.wake_all(self.waiting)

    def __enter__(self) -> "Socket":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def stand_ins(scheduler: Scheduler, files: Descriptors) -> dict[str, Any]:
    """The names of `socket` that are another thing in a simulation."""
    kind: type[Socket] = type("socket", (Socket,), {"_network": Network(scheduler, files)})

    def create_connection(address: Any, timeout: Any = None, *_: Any, **_named: Any) -> Socket:
        made = kind(socket.AF_INET)
        made.settimeout(timeout if isinstance(timeout, int | float) else None)
        try:
            made.connect(address)
        except OSError:
            made.close()
            raise
        return made

    def socketpair(*_: Any) -> tuple[Socket, Socket]:
        one, other = kind(socket.AF_UNIX), kind(socket.AF_UNIX)
        one.join(other)
        return one, other

    return {"socket": kind, "SocketType": kind, "create_connection": create_connection, "socketpair": socketpair}


def _place(address: Any) -> Any:
    return cast("tuple[Any, ...]", address)[1] if isinstance(address, tuple) else address


def _error(number: int) -> OSError:
    return OSError(number, os.strerror(number))
