"""``trade backup`` and ``trade restore``: save and restore a gateway's configuration, keys and state."""

import os
import shutil
import socket
import sqlite3
import tempfile
from collections.abc import Generator, Iterator
from contextlib import closing, contextmanager
from datetime import datetime, timezone
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Final, cast

import typer
from rich.markup import escape

from trade import Settings
from trade.errors import ConfigurationError
from trade.text_files import read_text
from trade.toml_files import read_toml_text
from trade_gateway._usage import UsageError
from trade_gateway.cli.operation._archive import (
    CONFIG,
    SQLITE_BESIDE,
    STATE,
    Manifest,
    Source,
    read_archive,
    unpack,
    write_archive,
)
from trade_gateway.cli.operation._file_closure import NamedFiles, named_files
from trade_gateway.supervisor._single_instance import held_in
from trade_gateway.terminal._output import Output, complain

_SQLITE: Final = b"SQLite format 3\0"
_PATIENCE_S: Final = 10.0
"""How long another process may lock a database, in seconds."""
_LOGS: Final = "logs"

Force = Annotated[bool, typer.Option("--force", help="Overwrite existing files.")]


def backup(
    file: Annotated[Path, typer.Argument(metavar="GATEWAY.toml", help="The gateway file, or a system file.")],
    archive: Annotated[Path | None, typer.Argument(metavar="OUT.tar.gz", help="The backup to write.")] = None,
    state: Annotated[
        Path | None, typer.Option(help="Folder for state; of a service: /var/lib/trade. \\[env: TRADE_STATE_DIR]")
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Check that a backup, the only argument, is complete; and exit.")
    ] = False,
    force: Force = False,
) -> None:
    """Back up a gateway file, the files it names, keys and state into one file.

    The gateway may run meanwhile. Only this user can read the backup, because it contains the gateway's keys.

    For example: trade backup /etc/trade/gateway.toml trade.tar.gz --state /var/lib/trade
    """
    out = Output(as_json=False)
    if check:
        if archive is not None:
            raise UsageError(where="--check", problem=f"takes only the backup: trade backup --check {archive}")
        with _said(file):
            _say(out, file, read_archive(file))
        return
    if archive is None:
        raise UsageError(where="OUT.tar.gz", problem=f"is missing: trade backup {file} OUT.tar.gz")
    if archive.exists() and not force:
        raise ConfigurationError(where=str(archive), problem="exists already; choose another name, or use --force")
    folder = (state or _state_folder()).absolute()
    if archive.absolute().is_relative_to(folder):
        raise ConfigurationError(where=str(archive), problem="is in the folder for state; choose another place")
    with _said(archive), _staging(archive) as staging:
        named = named_files(file)
        sources = [*_config(named, staging), *_states(named, folder, staging)]
        _say(out, archive, write_archive(archive, sources, _about(file)))
    if not any(source.path.startswith(STATE) for source in sources):
        complain(f"there is no state in {folder}; name the folder of the gateway with --state")


def restore(
    archive: Annotated[Path, typer.Argument(metavar="OUT.tar.gz", help="The backup.")],
    to: Annotated[Path, typer.Option(help="Folder for the gateway file and the files it names.")] = Path(),
    state: Annotated[Path | None, typer.Option(help="Folder for state. Default: state in the folder of --to.")] = None,
    force: Force = False,
) -> None:
    """Verify a backup as a whole, then restore it.

    Each file is replaced atomically.
    Stop the gateway first: nothing is written if one of its containers is known to run (one with a standby).
    As root, files get their owners back. Identities that an existing list revokes stay revoked.

    For example: trade restore trade.tar.gz --to /etc/trade --state /var/lib/trade
    """
    out = Output(as_json=False)
    folders = {CONFIG: to, STATE: state or to / STATE}
    with _said(to):
        manifest = read_archive(archive)
        _check_none_runs(manifest, folders[STATE])
        _check_places(manifest, folders, force=force)
        unknown = unpack(archive, manifest, folders, _keep_revoked)
    for names in unknown:
        complain(f"there is no {names} on this host, so their files are yours now; change that with `sudo chown`")
    _say(out, archive, manifest)
    out.say(escape(f"configuration in {folders[CONFIG]}, state in {folders[STATE]}"))
    file = next(entry for entry in manifest.files if entry.path == manifest.file).below(to)
    out.say(f"Next: [bold]trade gateway {escape(str(file))} --check[/]")


def _check_places(manifest: Manifest, folders: dict[str, Path], *, force: bool) -> None:
    """Raises ConfigurationError if a file exists already, or a link leads elsewhere."""
    there: list[str] = []
    for entry in manifest.files:
        folder = folders[entry.part]
        target = entry.below(folder)
        if not target.parent.resolve().is_relative_to(folder.resolve()):
            problem = f"{target.parent} is a link that leads out of {folder}; move it away"
            raise ConfigurationError(where=str(target), problem=f"{problem}. Nothing was written")
        if os.path.lexists(target):
            there.append(str(target))
    if there and not force:
        problem = "would be overwritten; use --force, or another folder with --to. Nothing was written"
        raise ConfigurationError(where=", ".join(there), problem=problem)


def _check_none_runs(manifest: Manifest, folder: Path) -> None:
    """Raises ConfigurationError if a container with a gateway's lease uses that state now."""
    systems = {entry.below(Path()).parts[0] for entry in manifest.files if entry.part == STATE}
    for lock in (lock for system in systems for lock in held_in(folder / system)):
        problem = "is in use by a running container; stop its gateway first. Nothing was written"
        raise ConfigurationError(where=str(lock), problem=problem)


def _keep_revoked(there: Path, fresh: Path) -> None:
    """Keeps identities revoked that were revoked since the backup."""
    now, then = _revoked(there), _revoked(fresh)
    if now is None or then is None or not now - then:
        return
    names = ", ".join(f'"{name}"' for name in sorted(now | then))
    with fresh.open("w", encoding="utf-8") as file:
        file.write(f"# Merged from a backup and the list that existed before.\nrevoked = [{names}]\n")
        file.flush()
        os.fsync(file.fileno())
    complain(f"{there}: {', '.join(sorted(now - then))} stays revoked, although the backup does not say so")


def _revoked(path: Path) -> set[str] | None:
    """Returns the names in a list of revoked identities; None for another file."""
    try:
        read = read_toml_text(read_text(path))
    except ValueError:
        return None
    names = read.get("revoked")
    if set(read) != {"revoked"} or not isinstance(names, list):
        return None
    return {name for name in cast("list[object]", names) if isinstance(name, str)}


def _about(file: Path) -> Manifest:
    now = datetime.now(timezone.utc).isoformat(timespec="seconds")
    here = socket.gethostname()
    name = f"{CONFIG}/{file.name}"
    return Manifest(format=1, version=version("trade-gateway"), host=here, made_at=now, file=name, files=[])


def _config(named: NamedFiles, staging: Path) -> Iterator[Source]:
    """Returns the file and those that it names. Raises ConfigurationError if one is missing or elsewhere."""
    folder = named.files[0].parent
    for one in named.files:
        if not one.is_relative_to(folder):
            problem = f"is not in {folder}, so a backup could not be restored elsewhere; move it there"
            raise ConfigurationError(where=str(one), problem=problem)
        try:
            yield Source(f"{CONFIG}/{one.relative_to(folder).as_posix()}", _copied(one, staging), one.stat())
        except FileNotFoundError:
            raise ConfigurationError(where=str(one), problem="is named, but does not exist") from None


def _states(named: NamedFiles, folder: Path, staging: Path) -> Iterator[Source]:
    """Returns the state of its systems, without logs."""
    for system in named.systems:
        for path in sorted((folder / system).rglob("*")):
            inside = path.relative_to(folder)
            if inside.parts[1] == _LOGS or path.is_symlink() or not path.is_file() or _belongs_to_database(path):
                continue
            try:
                yield _state(path, f"{STATE}/{inside.as_posix()}", staging)
            except FileNotFoundError:  # it was removed meanwhile
                continue


def _state(path: Path, name: str, staging: Path) -> Source:
    status = path.stat()
    if not _is_database(path):
        return Source(name, _copied(path, staging), status)
    copy = _fresh(staging)
    try:
        with (
            closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=rw", uri=True, timeout=_PATIENCE_S)) as source,
            closing(sqlite3.connect(copy)) as target,
        ):
            source.backup(target)
    except sqlite3.OperationalError as bad:
        raise ConfigurationError(where=str(path), problem=f"cannot be copied: {bad}") from None
    except sqlite3.DatabaseError as corrupt:
        complain(f"{path} is damaged and was copied as it is: {corrupt}")
        return Source(name, _copied(path, staging), status)
    return Source(name, copy, status, database=True)


def _is_database(path: Path) -> bool:
    with path.open("rb") as content:
        return content.read(len(_SQLITE)) == _SQLITE


def _belongs_to_database(path: Path) -> bool:
    owners = (path.with_name(path.name.removesuffix(end)) for end in SQLITE_BESIDE if path.name.endswith(end))
    return any(owner.is_file() for owner in owners)


def _copied(path: Path, staging: Path) -> Path:
    return Path(shutil.copyfile(path, _fresh(staging)))


def _fresh(staging: Path) -> Path:
    return staging / str(len(list(staging.iterdir())))


def _state_folder() -> Path:
    """Returns the folder for state of this user's containers. Raises UsageError."""
    kept = {name: os.environ[name] for name in os.environ if name == "TRADE_STATE_DIR" or name[:6] != "TRADE_"}
    folder = Settings.read(system="any", environment=kept).state_dir
    if folder is None:
        raise UsageError(where="--state", problem="is missing, and this user has no folder for state")
    return folder


@contextmanager
def _staging(archive: Path) -> Generator[Path]:
    """Makes a private folder beside the backup, on the disk with room for it."""
    with tempfile.TemporaryDirectory(prefix=".trade-backup-", dir=archive.absolute().parent) as folder:
        yield Path(folder)


@contextmanager
def _said(about: Path) -> Generator[None]:
    """Turns an OSError into a ConfigurationError."""
    try:
        yield
    except OSError as bad:
        where = str(bad.filename or about)
        raise ConfigurationError(where=where, problem=f"{bad.strerror or bad}; check its permissions") from None


def _say(out: Output, archive: Path, manifest: Manifest) -> None:
    counts = {part: sum(entry.part == part for entry in manifest.files) for part in (CONFIG, STATE)}
    out.say(
        f"{escape(str(archive))} is complete: TRADE {manifest.version} on {escape(manifest.host)}, {manifest.made_at}; "
        f"{counts[CONFIG]} files of the configuration, {counts[STATE]} of state"
    )
