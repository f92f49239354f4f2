"""Open e-stops on disk: a folder for each container with a file for each e-stop, read at the next start."""

import os
from pathlib import Path
from typing import Final

import msgspec

from trade._atomic_file import replace
from trade._protocol.keys import Address, is_chunk
from trade._protocol.messages import UNREADABLE, Estop

_PRIVATE: Final = 0o700


class EstopStore:
    """The files of one container. It also reads the shared files of an earlier release.

    Args:
        shared: the folder of all of a system's containers on this host; None: nothing is kept.
        own: the container; a program named after its process id finds its files again in the next process.
    """

    def __init__(self, shared: Path | None, own: Address) -> None:
        self._shared = shared
        name = own.container.removesuffix(f"-{os.getpid()}") or own.container
        self._own = None if shared is None else shared / own.identity / name

    def read(self) -> list[Estop]:
        """The e-stops that were open when this container last ended. An unreadable one counts as open."""
        notes = {path.stem: path for folder in self._folders() for path in sorted(folder.glob("*.json"))}
        return [_read(path) for name, path in notes.items() if is_chunk(name) and not path.is_dir()]

    def _folders(self) -> list[Path]:
        return [] if self._shared is None or self._own is None else [self._shared, self._own]

    def write(self, estop: Estop) -> None:
        """Writes an e-stop. Raises OSError."""
        if self._shared is None or self._own is None:
            return
        for folder in (self._shared, self._own.parent, self._own):
            folder.mkdir(mode=_PRIVATE, parents=True, exist_ok=True)
        replace(self._own / f"{estop.id}.json", msgspec.json.encode(estop))

    def remove(self, estop_id: str) -> None:
        """Removes an e-stop, if it has a file. Raises OSError."""
        for folder in self._folders():
            note = folder / f"{estop_id}.json"
            if not note.is_dir():  # an identity's name
                note.unlink(missing_ok=True)


def _read(path: Path) -> Estop:
    try:
        found = msgspec.json.decode(path.read_bytes(), type=Estop)
    except (OSError, *UNREADABLE) as bad:
        return Estop(path.stem, "unknown", f"its file {path} cannot be read: {bad}", 0.0)
    return found if found.id == path.stem else Estop(path.stem, found.by, found.reason, found.at)
