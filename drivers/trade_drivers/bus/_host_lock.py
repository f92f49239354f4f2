"""A lock that admits one driver per host to a device: a kernel name that one process at a time can own."""

import errno
import hashlib
import logging
import os
import socket
import sys
from pathlib import Path
from typing import Final

from trade_drivers.bus._holders import holders

_log = logging.getLogger("trade")
_SOCKETS: Final = Path("/proc/net/unix")
_LONGEST: Final = 50
"""Maximum length of the holder's description; a socket name has 107 bytes."""


class Taken(Exception):
    """Another driver on this host has the lock; the text names it, if known."""


class HostLock:
    """An advisory lock for all users: the name of a Unix socket in the abstract namespace, per network namespace.

    The kernel frees it when its process ends, for any reason. On systems without such names, it locks nothing.
    """

    def __init__(self, what: str, by: str, device: str = "") -> None:
        """Args:
        what: the locked device, such as ``socketcan:can0``.
        by: the holder's name for others, in addition to the process id.
        device: the serial line of the device, which drivers of servos lock with a file lock.
        """
        self._device = device
        self._name = f"trade/driver/{hashlib.sha256(what.encode()).hexdigest()[:16]}"
        shown = by.encode("ascii", "replace").decode()[-_LONGEST:]
        self._label = f"{self._name} process {os.getpid()} ({shown})"
        self._held: list[socket.socket] = []
        self._line: int | None = None

    def take(self) -> None:
        """Acquires the lock until `release`. Idempotent.

        Raises:
            Taken: another driver has the lock.
        """
        if self._held or not sys.platform.startswith("linux"):
            return
        try:
            self._bind(self._name)
            self._bind(self._label)  # others cannot query the holder of the first one
        except OSError as bad:
            if bad.errno == errno.EADDRINUSE and not self._held:
                raise Taken(self._holder()) from None
            _log.warning("cannot lock %s against other drivers on this host: %s", self._label, bad)
        if self._device:
            self._lock_device()

    def _lock_device(self) -> None:
        import fcntl  # noqa: PLC0415 - not on every system

        try:
            self._line = os.open(self._device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
            fcntl.flock(self._line, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.release()
            raise Taken(", ".join(holders(self._device)) or f"a process that `fuser {self._device}` names") from None
        except OSError as bad:  # opening the device reports the reason
            _log.debug("%s: %s", self._device, bad)

    def release(self) -> None:
        """Releases the lock. Idempotent."""
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
