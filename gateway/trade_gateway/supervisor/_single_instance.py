"""A lock file that a process holds for its life, so that a container has only one process on a host.

Libraries for lock files do not fit: their release also unlocks for every process that inherited the lock (decision 78).
"""

import contextlib
import fcntl
import os
from collections.abc import Generator
from pathlib import Path
from typing import Final

_FOLDER: Final = "locks"


def lock_of(folder: Path, gateway: str, child: str) -> Path:
    """Returns the lock file of a leased child, in the folder of a system's state."""
    return folder / _FOLDER / f"{gateway}.{child}.lock"


def held_in(folder: Path) -> list[Path]:
    """Returns the lock files in the folder of a system's state that a process holds now."""
    return [path for path in sorted((folder / _FOLDER).glob("*.lock")) if not is_free(path)]


@contextlib.contextmanager
def alone(path: Path | None) -> Generator[list[int]]:
    """Locks a file for a child process to inherit; it is free when that process and all heirs of the lock have ended.

    Args:
        path: the file; None: lock nothing.

    Raises:
        OSError: a process holds the lock, or the file cannot be locked.
    """
    if path is None:
        yield []
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise BlockingIOError(f"the previous process has not ended: {path} is locked") from None
        yield [file]
    finally:
        os.close(file)


def is_free(path: Path) -> bool:
    """Whether no process holds a lock file; False if that is unknown."""
    try:
        with alone(path):
            return True
    except OSError:
        return False
