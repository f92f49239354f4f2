"""Open e-stops on disk: a file for each, shared by a system's containers on one host, read at their next start."""

import os
import secrets
from pathlib import Path

import msgspec

from trade._keys import is_chunk
from trade._wire import UNREADABLE, Estop


class EstopStore:
    """A folder; none: nothing is kept."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder

    def read(self) -> list[Estop]:
        """Those that were open when the last container here ended. One that cannot be read is open all the same."""
        if self._folder is None or not self._folder.is_dir():
            return []
        return [_read(path) for path in sorted(self._folder.glob("*.json")) if is_chunk(path.stem)]

    def write(self, estop: Estop) -> None:
        """Keep it. Raises OSError."""
        if self._folder is None:
            return
        self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        fresh = self._folder / f".{estop.id}.{secrets.token_hex(4)}"  # other containers write it, too
        try:
            with fresh.open("wb") as file:
                file.write(msgspec.json.encode(estop))
                file.flush()
                os.fsync(file.fileno())
            fresh.replace(self._folder / f"{estop.id}.json")
        finally:
            fresh.unlink(missing_ok=True)

    def remove(self, estop_id: str) -> None:
        """Keep it no more. Raises OSError, but not if it is not there."""
        if self._folder is not None:
            (self._folder / f"{estop_id}.json").unlink(missing_ok=True)


def _read(path: Path) -> Estop:
    try:
        found = msgspec.json.decode(path.read_bytes(), type=Estop)
    except (OSError, *UNREADABLE) as bad:
        return Estop(path.stem, "unknown", f"its file {path} cannot be read: {bad}", 0.0)
    return found if found.id == path.stem else Estop(path.stem, found.by, found.reason, found.at)
