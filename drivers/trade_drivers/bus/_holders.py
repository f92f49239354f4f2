"""Finds the other programs on this host that have a serial port open."""

import os
import stat
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

_PROCESSES: Final = Path("/proc")
_TERMINALS: Final = range(136, 144)
"""The major numbers of pseudo-terminals (Documentation/admin-guide/devices.txt of Linux)."""
_MASTERS: Final = ("/dev/ptmx", "/dev/pts/ptmx")


def holders(path: str) -> list[str]:
    """Returns the processes, except this one, that have a port open, such as ``ModemManager (pid 812)``.

    Only root sees the processes of other users. The program behind a pseudo-terminal does not count. Takes some
    10 ms; on systems without /proc the list is empty.
    """
    if not sys.platform.startswith("linux"):
        return []
    try:
        status = Path(path).stat()
    except OSError:
        return []
    if not stat.S_ISCHR(status.st_mode):
        return []
    terminal = os.major(status.st_rdev) in _TERMINALS
    return [f"{_name(pid)} (pid {pid})" for pid in _pids() if _holds(pid, status.st_rdev, terminal=terminal)]


def _pids() -> Iterator[int]:
    own = str(os.getpid())
    return (int(each.name) for each in _PROCESSES.iterdir() if each.name.isdecimal() and each.name != own)


def _holds(pid: int, device: int, *, terminal: bool) -> bool:
    found = False
    with suppress(OSError):  # it has ended, or belongs to another user
        for each in (_PROCESSES / str(pid) / "fd").iterdir():
            with suppress(OSError):  # it was closed
                target = str(each.readlink())
                if terminal and target in _MASTERS:
                    return False
                found = found or (target.startswith("/dev/") and each.stat().st_rdev == device)
    return found


def _name(pid: int) -> str:
    try:
        return (_PROCESSES / str(pid) / "comm").read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return "a process"
