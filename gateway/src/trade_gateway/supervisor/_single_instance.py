"""A lock file that a process holds for its life, whoever started it: of one container there is one process on a host.

No library for lock files: these unlock when they are released, and with that every process the lock was passed on to
(decision 78).
"""

import contextlib
import fcntl
import os
from collections.abc import Generator
from pathlib import Path
from typing import Final

__all__ = ["alone", "held_in", "is_free", "lock_of"]

_FOLDER: Final = "locks"


def lock_of(folder: Path, gateway: str, child: str) -> Path:
    """The file of a child that a gateway has a lease on, in the folder of a system's state."""
    return folder / _FOLDER / f"{gateway}.{child}.lock"


def held_in(folder: Path) -> list[Path]:
    """Those in the folder of a system's state that a process has now."""
    return [path for path in sorted((folder / _FOLDER).glob("*.lock")) if not is_free(path)]


@contextlib.contextmanager
def alone(path: Path | None) -> Generator[list[int]]:
    """The lock of a file, to be passed on to a process; it is free once that one and all it passed it to have ended.

    Args:
        path: of the file; None: there is nothing to lock, and nothing to pass on.

    Raises:
        OSError: a process has it, or there can be none.
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
            raise BlockingIOError(f"the one before has not ended: {path} is locked") from None
        yield [file]
    finally:
        os.close(file)


def is_free(path: Path) -> bool:
    """Whether nobody has it; also no if that cannot be told."""
    try:
        with alone(path):
            return True
    except OSError:
        return False
