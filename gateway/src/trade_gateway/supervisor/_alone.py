"""A lock that a process has for its life, whoever started it: of one container there is one process on a host."""

import contextlib
import fcntl
import os
from collections.abc import Generator
from pathlib import Path

__all__ = ["alone", "is_free"]


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
