"""Pipes, pseudo-terminals and the waits for them, between threads of one simulation."""

import contextlib
import errno
import importlib
import itertools
import os
import select
import selectors
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, Final, Protocol

from trade.testing.virtual._scheduler import Scheduler, WaitList

_FIRST: Final = 1_000_000
"""Descriptors from here on are virtual; a process has never so many real ones."""
_SELECTORS: Final = ("DefaultSelector", "SelectSelector", "PollSelector", "EpollSelector", "KqueueSelector")


class Waitable(Protocol):
    """What a thread can wait for until it can be read."""

    waiting: WaitList

    @property
    def ready(self) -> bool:
        """Whether reading it returns at once."""
        ...


class _End:
    """One end of a pipe or a pseudo-terminal."""

    def __init__(self, *, terminal: bool) -> None:
        self.peer: _End = self
        self.incoming = bytearray()
        self.waiting: WaitList = deque()
        self.terminal: Final = terminal
        self.blocking = self.open = True
        self.baud = 0
        self.taken = False
        """Whether a serial port has it for itself."""

    @property
    def ready(self) -> bool:
        """Whether reading it returns at once."""
        return bool(self.incoming) or not self.open or not self.peer.open


class Descriptors:
    """The virtual descriptors of one simulation."""

    def __init__(self, scheduler: Scheduler) -> None:
        self._scheduler = scheduler
        self._numbers = itertools.count(_FIRST)
        self._waitable: dict[int, Waitable] = {}
        self._terminals: dict[str, int] = {}

    def pipe(self) -> tuple[int, int]:
        """As `os.pipe`: the end to read, and the one to write."""
        return self._pair(terminal=False)

    def openpty(self) -> tuple[int, int]:
        """As `os.openpty`."""
        master, slave = self._pair(terminal=True)
        self._terminals[self.ttyname(slave)] = slave
        return master, slave

    def ttyname(self, number: int) -> str:
        """The path of a virtual terminal. It exists in no file system."""
        return f"/dev/pts/virtual-{number}"

    def _pair(self, *, terminal: bool) -> tuple[int, int]:
        one, other = _End(terminal=terminal), _End(terminal=terminal)
        one.peer, other.peer = other, one
        return self.add(one), self.add(other)

    def add(self, end: "Waitable") -> int:
        """A number for something else that can be waited for."""
        number = next(self._numbers)
        self._waitable[number] = end
        return number

    def forget(self, number: int) -> None:
        """Frees the number."""
        self._waitable.pop(number, None)

    def end(self, number: int) -> _End:
        """The open end of a number."""
        end = self._waitable.get(number)
        if not isinstance(end, _End):
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        return end

    def read(self, number: int, size: int) -> bytes:
        """As `os.read`."""
        end = self.end(number)
        while not end.ready:
            if not end.blocking:
                raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
            self._scheduler.wait([end.waiting], None)
        if not end.incoming and end.terminal:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        data = bytes(end.incoming[:size])
        del end.incoming[:size]
        return data

    def set_blocking(self, number: int, blocking: bool) -> None:
        """As `os.set_blocking`."""
        self.end(number).blocking = blocking

    def write(self, number: int, data: bytes) -> int:
        """As `os.write`; unread bytes are kept without a limit."""
        end = self.end(number)
        if not end.peer.open:
            code = errno.EIO if end.terminal else errno.EPIPE
            raise OSError(code, os.strerror(code))
        end.peer.incoming += data
        self._scheduler.wake_all(end.peer.waiting)
        return len(data)

    def close(self, number: int) -> None:
        """As `os.close`."""
        end = self.end(number)
        self.forget(number)
        end.open = False
        self._scheduler.wake_all(end.waiting)
        self._scheduler.wake_all(end.peer.waiting)

    def wait(self, numbers: Sequence[int], timeout_s: float | None) -> list[int]:
        """Those that can be read, as soon as there is one, or the time is over."""
        scheduler = self._scheduler
        scheduler.may_yield()
        until_ns = None if timeout_s is None else scheduler.now_ns + round(timeout_s * 1e9)
        while True:
            found = [number for number in numbers if number not in self._waitable or self._waitable[number].ready]
            left_s = None if until_ns is None else (until_ns - scheduler.now_ns) / 1e9
            if found or (left_s is not None and left_s <= 0):
                return found
            scheduler.wait([self._waitable[number].waiting for number in numbers], left_s)

    def is_open(self, number: int) -> bool:
        """Whether a number is in use."""
        return number in self._waitable

    def open_terminal(self, path: str) -> int | None:
        """The number of the terminal of a path; None if there is none."""
        return self._terminals.get(path)


def stand_ins(files: Descriptors) -> dict[ModuleType, dict[str, Any]]:
    """For each module with names of files and terminals, the names that are another thing in a simulation."""
    replaced: dict[ModuleType, dict[str, Any]] = {
        os: {
            "read": _either(files.read, os.read),
            "write": _either(files.write, os.write),
            "close": _either(files.close, os.close),
            "set_blocking": _either(files.set_blocking, os.set_blocking),
            "ttyname": _either(files.ttyname, os.ttyname),
            "pipe": files.pipe,
            "openpty": files.openpty,
        },
        select: {
            "poll": partial(_Poll, files),
            "epoll": partial(_Epoll, files),
            "select": partial(_select, files),
        },
        selectors: dict.fromkeys(_SELECTORS, partial(Selector, files)),
    }
    for name, made in (("pty", _pty), ("tty", _tty), ("termios", _termios), ("serial", _serial)):
        with contextlib.suppress(ImportError):  # pyserial need not be installed
            module = importlib.import_module(name)
            replaced[module] = made(module, files)
    return replaced


def _either(virtual: Callable[..., Any], real: Callable[..., Any]) -> Callable[..., Any]:
    """The one for virtual descriptors and the real one for all others."""

    def call(number: Any, *rest: Any) -> Any:
        return (virtual if isinstance(number, int) and number >= _FIRST else real)(number, *rest)

    return call


class _PollBase:
    """What `select.poll` and `select.epoll` share."""

    def __init__(self, files: Descriptors) -> None:
        self._files = files
        self._numbers: dict[int, int] = {}

    def register(self, file: Any, mask: int = select.POLLIN) -> None:
        self._numbers[_number_of(file)] = mask

    def modify(self, file: Any, mask: int) -> None:
        self._numbers[_number_of(file)] = mask

    def unregister(self, file: Any) -> None:
        del self._numbers[_number_of(file)]

    def close(self) -> None:
        self._numbers.clear()

    def _wait(self, timeout_s: float | None) -> list[tuple[int, int]]:
        writing = {number for number, mask in self._numbers.items() if mask & select.POLLOUT}
        readable = set(self._files.wait(list(self._numbers), 0.0 if writing else timeout_s))
        return [
            (number, (select.POLLIN if number in readable else 0) | (select.POLLOUT if number in writing else 0))
            for number in self._numbers
            if number in readable or number in writing
        ]


class _Poll(_PollBase):
    """As `select.poll`: its time is in milliseconds."""

    def poll(self, timeout_ms: float | None = None) -> list[tuple[int, int]]:
        return self._wait(None if timeout_ms is None or timeout_ms < 0 else timeout_ms / 1e3)


class _Epoll(_PollBase):
    """As `select.epoll`: its time is in seconds."""

    def __init__(self, files: Descriptors, *_: int) -> None:
        super().__init__(files)

    def poll(self, timeout: float | None = None, _most: int = -1) -> list[tuple[int, int]]:
        return self._wait(None if timeout is None or timeout < 0 else timeout)

    def __enter__(self) -> "_Epoll":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _select(
    files: Descriptors, reading: Any, writing: Any, _failing: Any, timeout_s: float | None = None
) -> tuple[list[Any], list[Any], list[Any]]:
    """As `select.select`: everything can be written at once."""
    numbers = {_number_of(file): file for file in reading}
    found = files.wait(list(numbers), 0.0 if writing else timeout_s)
    return [numbers[number] for number in found], list(writing), []


class Selector(selectors.SelectSelector):
    """As any of `selectors`."""

    def __init__(self, files: Descriptors) -> None:
        super().__init__()
        self._files = files

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        keys = list(self.get_map().values())
        writing = any(key.events & selectors.EVENT_WRITE for key in keys)
        reading = [key.fd for key in keys if key.events & selectors.EVENT_READ]
        readable = set(self._files.wait(reading, 0.0 if writing else timeout))
        ready = [
            key.events & (selectors.EVENT_WRITE | (selectors.EVENT_READ if key.fd in readable else 0)) for key in keys
        ]
        return [(key, events) for key, events in zip(keys, ready, strict=True) if events]


def _number_of(file: Any) -> int:
    return file if isinstance(file, int) else file.fileno()


def _pty(_: ModuleType, files: Descriptors) -> dict[str, Any]:
    return {"openpty": files.openpty}


def _tty(module: ModuleType, _: Descriptors) -> dict[str, Any]:
    return {"setraw": _either(lambda *_: None, module.setraw)}


def _termios(module: ModuleType, files: Descriptors) -> dict[str, Any]:
    def tcgetattr(number: int) -> list[Any]:
        rate = getattr(module, f"B{files.end(number).peer.baud}", None)
        return [0, 0, 0, 0, rate, rate, []]

    def tcflush(number: int, _queue: int) -> None:
        try:
            end = files.end(number)
        except OSError as gone:
            raise module.error(*gone.args) from None
        if not end.peer.open:
            raise module.error(errno.EIO, os.strerror(errno.EIO))
        end.incoming.clear()

    return {"tcgetattr": _either(tcgetattr, module.tcgetattr), "tcflush": _either(tcflush, module.tcflush)}


def _serial(module: ModuleType, files: Descriptors) -> dict[str, Any]:
    class Serial:
        """As `serial.Serial`, as far as drivers use it: they read and write its descriptor."""

        def __init__(self, port: str, baudrate: int = 9600, **_: Any) -> None:
            number = files.open_terminal(_target_of(port))
            if number is None or not files.is_open(number):
                raise module.SerialException(errno.ENOENT, f"could not open port {port}: no such virtual terminal")
            end = files.end(number)
            if end.taken:
                busy = os.strerror(errno.EAGAIN)
                raise module.SerialException(errno.EAGAIN, f"Could not exclusively lock port {port}: {busy}")
            end.taken, end.baud = True, baudrate
            end.incoming.clear()
            self.fd: int | None = number
            self._end = end

        def close(self) -> None:
            self._end.taken, self.fd = False, None

        def set_low_latency_mode(self, _: bool) -> None: ...

    return {"Serial": Serial}


def _target_of(port: str) -> str:
    path = Path(port)
    return str(path.readlink() if path.is_symlink() else path.resolve())
