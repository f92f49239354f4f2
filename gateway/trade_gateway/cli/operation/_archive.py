"""The archive of a backup: written atomically, verified as a whole before use, restored file by file.

It is a compressed tar archive. Its first member is ``manifest.json``; then follow the files: ``config/...`` for the
folder of the gateway file and ``state/...`` for the folder for state.
"""

import grp
import gzip
import hashlib
import io
import itertools
import os
import pwd
import shutil
import tarfile
import zlib
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import IO, Annotated, Final, NamedTuple

import msgspec
from msgspec import Meta, Struct

from trade.atomic_files import fresh_beside
from trade.errors import ConfigurationError

CONFIG: Final = "config"
STATE: Final = "state"
SQLITE_BESIDE: Final = ("-wal", "-shm", "-journal")
"""Suffixes of the files of an SQLite database, which would damage another database."""
_MANIFEST: Final = "manifest.json"
_LONGEST_MANIFEST: Final = 16 * 1024 * 1024
_PIECE: Final = 1024 * 1024
_FOLDER_MODES: Final = {CONFIG: 0o755, STATE: 0o700}


class ArchivedFile(Struct, frozen=True):
    """One file of the archive."""

    path: str
    """The path in the archive: ``config/policy.toml``."""
    size: int
    sha256: str
    mode: Annotated[int, Meta(ge=0, le=0o777)]
    owner: str
    group: str
    database: bool = False
    """Whether it is an SQLite database."""

    @property
    def part(self) -> str:
        """``config`` or ``state``."""
        return self.path.partition("/")[0]

    def below(self, folder: Path) -> Path:
        """Returns its path below the folder of its part."""
        return folder / self.path.partition("/")[2]


class Manifest(Struct, frozen=True):
    """The manifest of a backup."""

    format: Annotated[int, Meta(ge=1, le=1)]
    version: str
    """The version of TRADE."""
    host: str
    made_at: str
    file: str
    """The path of the gateway file in the archive."""
    files: list[ArchivedFile]


class Source(NamedTuple):
    """A file to back up."""

    path: str
    """The path in the archive."""
    content: Path
    """The file with the content to store."""
    status: os.stat_result
    """The status of the original, whose owner and mode are stored, too."""
    database: bool = False


def write_archive(out: Path, sources: Sequence[Source], about: Manifest) -> Manifest:
    """Writes a backup that only this user can read, atomically; returns its manifest.

    Args:
        out: the file, which is replaced if it exists.
        sources: the files, which must not change meanwhile.
        about: the manifest without the files.

    Raises:
        OSError: the backup cannot be written.
    """
    manifest = msgspec.structs.replace(about, files=[_entry(source) for source in sources])
    text = msgspec.json.format(msgspec.json.encode(manifest))
    fresh = fresh_beside(out)
    try:
        with os.fdopen(os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
            with tarfile.open(fileobj=file, mode="w:gz") as archive:
                archive.addfile(_member(_MANIFEST, len(text), 0o600), io.BytesIO(text))
                for source, entry in zip(sources, manifest.files, strict=True):
                    with source.content.open("rb") as content:
                        archive.addfile(_member(entry.path, entry.size, entry.mode), content)
            file.flush()
            os.fsync(file.fileno())
        fresh.replace(out)
    finally:
        fresh.unlink(missing_ok=True)
    return manifest


def read_archive(path: Path) -> Manifest:
    """Verifies a whole backup.

    Raises:
        ConfigurationError: the backup is damaged or incomplete, or has paths outside its folders.
    """
    with _opened(path) as (archive, manifest):
        names = {entry.path for entry in manifest.files}
        if len(names) != len(manifest.files) or manifest.file not in names:
            raise _refused(path, "its manifest contradicts itself")
        for wrong in (entry.path for entry in manifest.files if not _stays_inside(entry.path)):
            raise _refused(path, f"{wrong!r} leads out of its folder")
        for member, entry in _files(path, archive, manifest):
            _copy(path, archive, member, entry, lambda _: None)
    return manifest


def unpack(
    path: Path,
    manifest: Manifest,
    folders: Mapping[str, Path],
    before: Callable[[Path, Path], None] = lambda _there, _fresh: None,
) -> list[str]:
    """Restores the files of a backup, each atomically; returns owners that this host does not know.

    Args:
        path: the backup.
        manifest: its manifest, from `read_archive`.
        folders: the target folders by part.
        before: called with each existing file and its replacement.

    Raises:
        ConfigurationError: the backup has changed since it was read.
        OSError: a file cannot be written.
    """
    unknown = set[str]()
    with _opened(path) as (archive, again):
        if again != manifest:
            raise _refused(path, "it was changed while it was read")
        for member, entry in _files(path, archive, manifest):
            target = entry.below(folders[entry.part])
            _make_folder(target.parent, entry, unknown)
            fresh = fresh_beside(target)
            try:
                with os.fdopen(os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
                    _copy(path, archive, member, entry, file.write)
                    file.flush()
                    os.fsync(file.fileno())
                if target.is_file():
                    before(target, fresh)
                _give(fresh, entry, unknown)
                fresh.chmod(entry.mode)
                for end in SQLITE_BESIDE if entry.database else ():
                    target.with_name(target.name + end).unlink(missing_ok=True)
                fresh.replace(target)
            finally:
                fresh.unlink(missing_ok=True)
    return sorted(unknown)


def _make_folder(folder: Path, entry: ArchivedFile, unknown: set[str]) -> None:
    if not folder.exists():
        _make_folder(folder.parent, entry, unknown)
        folder.mkdir(_FOLDER_MODES[entry.part])
        _give(folder, entry, unknown)


def _give(path: Path, entry: ArchivedFile, unknown: set[str]) -> None:
    """Changes the owner, if this process is root."""
    if os.geteuid() == 0:
        try:
            shutil.chown(path, entry.owner, entry.group)
        except LookupError:
            unknown.add(f"{entry.owner}:{entry.group}")


def _entry(source: Source) -> ArchivedFile:
    status, seen = source.status, hashlib.sha256()
    with source.content.open("rb") as content:
        size = sum(len(piece) for piece in _pieces(content, seen.update))
    return ArchivedFile(
        path=source.path,
        size=size,
        sha256=seen.hexdigest(),
        mode=status.st_mode & 0o777,
        owner=_name(lambda: pwd.getpwuid(status.st_uid).pw_name, status.st_uid),
        group=_name(lambda: grp.getgrgid(status.st_gid).gr_name, status.st_gid),
        database=source.database,
    )


def _name(look_up: Callable[[], str], number: int) -> str:
    try:
        return look_up()
    except KeyError:
        return str(number)


def _member(path: str, size: int, mode: int) -> tarfile.TarInfo:
    member = tarfile.TarInfo(path)
    member.size, member.mode = size, mode
    return member


@contextmanager
def _opened(path: Path) -> "Generator[tuple[tarfile.TarFile, Manifest]]":
    """Opens the archive after its manifest; damage found while it is read raises ConfigurationError."""
    try:
        with tarfile.open(path, "r:gz") as archive:
            first = archive.next()
            if first is None or first.name != _MANIFEST or not first.isreg() or first.size > _LONGEST_MANIFEST:
                raise _refused(path, "it does not begin with a manifest")
            text = archive.extractfile(first)
            assert text is not None  # noqa: S101 - a regular file
            yield archive, msgspec.json.decode(text.read(), type=Manifest)
    except FileNotFoundError:
        raise ConfigurationError(where=str(path), problem="there is no such file") from None
    except (
        tarfile.TarError,
        gzip.BadGzipFile,
        zlib.error,
        EOFError,
        msgspec.DecodeError,
        UnicodeDecodeError,
    ) as damaged:
        raise _refused(path, str(damaged)) from None


def _files(path: Path, archive: tarfile.TarFile, manifest: Manifest) -> Iterator[tuple[tarfile.TarInfo, ArchivedFile]]:
    """Returns the files after the manifest. Raises ConfigurationError if they differ from it."""
    missing = {entry.path: entry for entry in manifest.files}
    for member in itertools.islice(archive, 1, None):
        entry = missing.pop(member.name, None)
        if entry is None:
            raise _refused(path, f"{member.name!r} is not in its manifest, or occurs twice")
        yield member, entry
    if missing:
        raise _refused(path, f"{', '.join(missing)} is missing")


def _copy(
    path: Path, archive: tarfile.TarFile, member: tarfile.TarInfo, entry: ArchivedFile, to: Callable[[bytes], object]
) -> None:
    """Reads a file of the archive. Raises ConfigurationError if it differs from the manifest."""
    if not member.isreg() or member.size != entry.size:
        raise _refused(path, f"{entry.path} is not a file of {entry.size} bytes")
    content, seen = archive.extractfile(member), hashlib.sha256()
    assert content is not None  # noqa: S101 - a regular file
    for piece in _pieces(content, seen.update):
        to(piece)
    if seen.hexdigest() != entry.sha256:
        raise _refused(path, f"{entry.path} differs from the file that was backed up")


def _pieces(content: IO[bytes], see: Callable[[bytes], object]) -> Generator[bytes]:
    while piece := content.read(_PIECE):
        see(piece)
        yield piece


def _stays_inside(path: str) -> bool:
    parts = PurePosixPath(path).parts
    return len(parts) > 1 and parts[0] in (CONFIG, STATE) and ".." not in parts and "/".join(parts) == path


def _refused(path: Path, reason: str) -> ConfigurationError:
    return ConfigurationError(where=str(path), problem=f"is no backup, or a damaged one: {reason}; use another one")
