"""Atomic file writes: a file appears completely or not at all."""

import os
import secrets
from pathlib import Path


def claim(path: Path, text: bytes) -> None:
    """Creates a file for this user only. Raises FileExistsError."""
    made = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    try:
        with os.fdopen(made, "wb") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
    except BaseException:
        path.unlink(missing_ok=True)
        raise


def replace(path: Path, text: bytes, mode: int = 0o600) -> None:
    """Replaces a file atomically."""
    fresh = fresh_beside(path)
    try:
        claim(fresh, text)
        fresh.chmod(mode)
        fresh.replace(path)
    except BaseException:
        fresh.unlink(missing_ok=True)
        raise


def fresh_beside(path: Path) -> Path:
    """Returns an unused name in the same folder, from which a file can atomically replace the other one."""
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}")
