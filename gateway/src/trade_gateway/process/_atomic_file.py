"""Files that are there as a whole or not at all."""

import os
import secrets
from pathlib import Path

__all__ = ["claim", "fresh_beside", "replace"]


def claim(path: Path, text: bytes) -> None:
    """Write a file for this user only. Raises FileExistsError: it is there already."""
    made = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    try:
        with os.fdopen(made, "wb") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
    except BaseException:
        path.unlink(missing_ok=True)
        raise


def replace(path: Path, text: bytes, mode: int) -> None:
    """Write a file in place of another in one step."""
    fresh = fresh_beside(path)
    try:
        claim(fresh, text)
        fresh.chmod(mode)
        fresh.replace(path)
    except BaseException:
        fresh.unlink(missing_ok=True)
        raise


def fresh_beside(path: Path) -> Path:
    """A name in the same folder that nobody has; what is written there can take the place of the other in one step."""
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}")
