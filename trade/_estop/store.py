"""Open e-stops on disk: a folder for each container with a file for each e-stop, read at the next start."""

import logging
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import msgspec

from trade._settings import Settings
from trade.atomic_files import replace
from trade.default_system import account_name, earlier_folders
from trade.protocol.keys import Address, is_chunk
from trade.protocol.messages import UNREADABLE, Estop

_logger = logging.getLogger("trade")
_PRIVATE: Final = 0o700


class EstopStore:
    """The files of one container. It also reads files of an earlier release, which containers shared, and of all
    earlier names of the default system and of its user's identity.

    Args:
        settings: of the container; they say where files are kept, if at all.
        own: the container; a program named after its process id finds its files again in the next process.
    """

    def __init__(self, settings: Settings, own: Address) -> None:
        bases = () if settings.state_dir is None else (settings.state_dir, *settings.estop_dirs)
        self._system = settings.system
        self._bases = bases
        self._name = own.container.removesuffix(f"-{os.getpid()}") or own.container
        self._identity = own.identity
        self._default = not settings.explicit_system
        """Whether this is the default system, which had other names."""
        self._unnamed = settings.tls is None and own.identity == account_name()
        """Whether its identity is that of the account, which had the name of a variable, such as ``USER``."""

    def read(self) -> list[Estop]:
        """The e-stops that were open when this container last ended. An unreadable one counts as open."""
        notes = {path.stem: path for path in self._notes("*")}
        return [_read(path) for name, path in notes.items() if is_chunk(name)]

    def _own(self) -> list[Path]:
        return [base / self._system / "estop" / self._identity / self._name for base in self._bases]

    def _notes(self, estop_id: str) -> Iterator[Path]:
        """The files of an e-stop, or of all; those of the present name come last."""
        for base in self._bases:
            earlier = [one / "estop" for one in earlier_folders(base, self._system)] if self._default else []
            shared, whose = base / self._system / "estop", "*" if self._unnamed else self._identity
            for folder in (*earlier, shared):
                for note in (*folder.glob(f"{whose}/{self._name}/{estop_id}.json"), *folder.glob(f"{estop_id}.json")):
                    if not note.is_dir() and _own_file(note):  # a directory: an identity's name
                        yield note
            yield from (shared / self._identity / self._name).glob(f"{estop_id}.json")

    def write(self, estop: Estop) -> None:
        """Writes an e-stop. Raises OSError."""
        for place, own in enumerate(self._own()):
            try:
                for folder in (own.parent.parent, own.parent, own):
                    folder.mkdir(mode=_PRIVATE, parents=True, exist_ok=True)
                replace(own / f"{estop.id}.json", msgspec.json.encode(estop))
            except OSError as bad:
                if not place:
                    raise
                _logger.warning("%s: e-stop %s cannot be written there, too: %s", own, estop.id, bad)

    def remove(self, estop_id: str) -> None:
        """Removes an e-stop, if it has a file. Raises OSError."""
        for note in self._notes(estop_id):
            note.unlink(missing_ok=True)


def _own_file(note: Path) -> bool:
    """Whether this user wrote it: another one may have kept files here, too, as under ``sudo -E``."""
    try:
        return not hasattr(os, "getuid") or note.lstat().st_uid == os.getuid()
    except OSError:
        return False


def _read(path: Path) -> Estop:
    try:
        found = msgspec.json.decode(path.read_bytes(), type=Estop)
    except (OSError, *UNREADABLE) as bad:
        return Estop(path.stem, "unknown", f"its file {path} cannot be read: {bad}", 0.0)
    return found if found.id == path.stem else Estop(path.stem, found.by, found.reason, found.at)
