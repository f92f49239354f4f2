"""Code that other containers bring: archives of modules, which a container takes if their hash is on its list."""

import hashlib
import io
import logging
import sys
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from trade.atomic_files import replace
from trade.errors import CodeRefused, ConfigurationError

_logger = logging.getLogger("trade")
MOST_BYTES: Final = 32 << 20
_NATIVE: Final = (".so", ".pyd", ".dll", ".dylib")
_EARLIEST: Final = (1980, 1, 1, 0, 0, 0)


def hash_of(archive: bytes) -> str:
    """The SHA-256 of an archive, in hexadecimal digits."""
    return hashlib.sha256(archive).hexdigest()


def pack(path: Path) -> bytes:
    """An archive of modules: a wheel or a zip file as it is, or the files of a folder.

    The same files give the same archive on each computer. A folder with ``__init__.py`` is a package of its name; the
    modules of any other folder are at the top.

    Raises:
        ConfigurationError: it cannot be read, has no modules, or is too large.
    """
    try:
        archive = _zipped(path.absolute()) if path.is_dir() else path.read_bytes()
    except OSError as bad:
        raise ConfigurationError(where=str(path), problem=f"cannot be read: {bad.strerror or bad}") from None
    if problem := _problem(archive):
        raise ConfigurationError(where=str(path), problem=problem)
    return archive


def _zipped(folder: Path) -> bytes:
    top = folder.parent if (folder / "__init__.py").exists() else folder
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", zipfile.ZIP_STORED) as archive:
        for file in sorted(folder.rglob("*")):
            parts = file.relative_to(folder).parts
            if file.is_file() and "__pycache__" not in parts and not any(part.startswith(".") for part in parts):
                name = file.relative_to(top).as_posix()
                archive.writestr(zipfile.ZipInfo(name, _EARLIEST), file.read_bytes())
    return made.getvalue()


def _problem(archive: bytes) -> str:
    """Why Python cannot import from it; empty if it can."""
    if len(archive) > MOST_BYTES:
        return f"has {len(archive)} bytes, and at most {MOST_BYTES} are taken"
    try:
        with zipfile.ZipFile(io.BytesIO(archive)) as opened:
            names = opened.namelist()
    except zipfile.BadZipFile:
        return "is no wheel, no zip file and no folder"
    if native := next((name for name in names if name.endswith(_NATIVE)), ""):
        return f"has {native}, and compiled modules are not imported from an archive; install it there with pip"
    return "" if any(name.endswith(".py") for name in names) else "has no modules"


class CodeStore:
    """The archives that a container has taken. It imports from them after everything that is installed.

    Args:
        folder: where they are kept; None: the container keeps nothing, and takes none.
        allowed: the hashes of the archives that it takes.
        container: its name.
    """

    def __init__(self, folder: Path | None, allowed: Sequence[str], container: str) -> None:
        self._folder = folder
        self._allowed = tuple(allowed)
        self._container = container
        if folder is not None:
            for sha256 in self._allowed:
                _use_kept(sha256, folder / f"{sha256}.zip")

    def add(self, archive: bytes) -> str:
        """Keeps an archive and imports from it, now and after a restart. Idempotent.

        Returns:
            Its hash.

        Raises:
            CodeRefused: it is not on the list, is no archive of modules, or cannot be kept; nothing was imported.
        """
        sha256 = hash_of(archive)
        if sha256 not in self._allowed:
            raise self._refusal(sha256, "not on its list: start it with `trade container --code`, or set TRADE_CODE")
        if problem := _problem(archive):
            raise self._refusal(sha256, f"the archive {problem}")
        if self._folder is None:
            raise self._refusal(sha256, "it has no folder for state: set TRADE_STATE_DIR")
        kept = self._folder / f"{sha256}.zip"
        try:
            kept.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            replace(kept, archive)
        except OSError as bad:
            raise self._refusal(sha256, f"it cannot be kept in {self._folder}: {bad.strerror or bad}") from None
        _use(kept)
        return sha256

    def _refusal(self, sha256: str, reason: str) -> CodeRefused:
        return CodeRefused(sha256=sha256, container=self._container, reason=reason)


def _use_kept(sha256: str, kept: Path) -> None:
    try:
        archive = kept.read_bytes()
    except FileNotFoundError:
        return
    except OSError as bad:
        _logger.warning("code %s cannot be read: %s", kept, bad)
        return
    if hash_of(archive) == sha256:
        _use(kept)
    else:
        _logger.error("code %s is not what was brought: its hash is another one. It is not imported", kept)


def _use(archive: Path) -> None:
    if str(archive) not in sys.path:
        sys.path.append(str(archive))  # at the end: nothing that is installed is replaced
