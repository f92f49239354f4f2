"""Text files that clients show and change: a client overwrites no change that it has not seen."""

import difflib
import hashlib
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Final

from msgspec import Struct

from trade.atomic_files import replace
from trade.errors import ConfigurationError
from trade.text_files import as_before, as_text

__all__ = ["Document", "FileText"]


class FileText(Struct, frozen=True, kw_only=True):
    """The contents of a file."""

    path: str
    text: str
    version: str
    """Identifies these contents. A change names the version that it was made from."""


class Document:
    """A text file of a configuration, which others may write, too."""

    def __init__(self, path: Path) -> None:
        self.path: Final = path
        self._writing = threading.Lock()

    def read(self) -> FileText:
        """Returns its contents. Raises ConfigurationError: it cannot be read."""
        try:
            data = self.path.read_bytes()
            return FileText(path=str(self.path), text=as_text(data), version=hashlib.sha256(data).hexdigest()[:16])
        except (OSError, UnicodeDecodeError) as bad:
            raise ConfigurationError(where=str(self.path), problem=f"cannot be read: {bad}") from None

    def write(self, text: str, version: str, check: Callable[[], object]) -> None:
        """Replaces its contents atomically; keeps its permissions.

        Args:
            text: the new contents.
            version: of the contents that they were made from.
            check: raises if they are wrong; then nothing is written.

        Raises:
            ConfigurationError: it was changed meanwhile, or cannot be written.
        """
        with self._writing:
            if self.read().version != version:
                problem = "was changed meanwhile. Load it again, and repeat the change"
                raise ConfigurationError(where=str(self.path), problem=problem)
            check()
            target = self.path.resolve()
            try:
                replace(target, as_before(target.read_bytes(), text), target.stat().st_mode & 0o7777)
            except OSError as bad:
                raise ConfigurationError(where=str(self.path), problem=f"cannot be written: {bad}") from None

    def diff(self, text: str) -> list[str]:
        """Returns the lines in which a text differs, as a unified diff; empty if none."""
        lines = difflib.unified_diff(self.read().text.splitlines(), text.splitlines(), "now", "new", lineterm="")
        return list(lines)
