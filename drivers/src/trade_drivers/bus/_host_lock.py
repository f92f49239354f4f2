"""Of what is driven from a host there is one driver: a name that the kernel gives to one process at a time."""

import errno
import hashlib
import logging
import os
import socket
import sys
from pathlib import Path
from typing import Final

__all__ = ["HostLock", "Taken"]

_log = logging.getLogger("trade")
_SOCKETS: Final = Path("/proc/net/unix")
_LONGEST: Final = 50
"""Letters of a holder's description: a name has 107."""


class Taken(Exception):
    """Another driver of this host has it; who, as far as that is known."""


class HostLock:
    """An advisory lock, whichever user asks: a Unix socket's name in the abstract namespace, as CAN interfaces have it.

    It is free as soon as its process has ended, however that came. Where there are no such names nothing is locked.
    """

    def __init__(self, what: str, by: str, device: str = "") -> None:
        """Args:
        what: is locked, such as ``socketcan:can0``.
        by: whom others are told, besides the number of this process.
        device: a serial line that it is reached through, which drivers of servos lock by a file lock.
        """
        self._device = device
        self._name = f"trade/driver/{hashlib.sha256(what.encode()).hexdigest()[:16]}"
        shown = by.encode("ascii", "replace").decode()[-_LONGEST:]
        self._label = f"{self._name} process {os.getpid()} ({shown})"
        self._held: list[socket.socket] = []
        self._line: int | None = None

    def take(self) -> None:
        """Have it, until `release`; once more is fine.

        Raises:
            Taken: another driver has it.
        """
        if self._held or not sys.platform.startswith("linux"):
            return
        try:
            self._bind(self._name)
            self._bind(self._label)  # nobody can ask who has the first one
        except OSError as bad:
            if bad.errno == errno.EADDRINUSE and not self._held:
                raise Taken(self._holder()) from None
            _log.warning("no lock tells other drivers of this host that %s is in use: %s", self._label, bad)
        if self._device:
            self._lock_device()

    def _lock_device(self) -> None:
        import fcntl  # noqa: PLC0415 - not on every system

        try:
            self._line = os.open(self._device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
            fcntl.flock(self._line, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.release()
            raise Taken(f"a process that `fuser {self._device}` names") from None
        except OSError as bad:  # whoever opens it says why
            _log.debug("%s: %s", self._device, bad)

    def release(self) -> None:
        """Let go of it; more than once is fine."""
        while self._held:
            self._held.pop().close()
        if self._line is not None:
            os.close(self._line)
            self._line = None

    def _bind(self, name: str) -> None:
        lock = socket.socket(socket.AF_UNIX)
        try:
            lock.bind(f"\0{name}")
        except OSError:
            lock.close()
            raise
        self._held.append(lock)

    def _holder(self) -> str:
        try:
            names = _SOCKETS.read_text(errors="replace")
        except OSError:
            names = ""
        return names.partition(f"@{self._name} ")[2].partition("\n")[0] or "another process"
