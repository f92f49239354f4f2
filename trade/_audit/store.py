"""An audit record on disk: one SQLite file for each container; rows are added, and the oldest dropped.

Several processes may write to one file (a container that is started twice): each addition starts from the end that the
file has at that moment.
"""

import contextlib
import os
import sqlite3
from collections.abc import Callable, Generator, Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from msgspec import structs

from trade._audit.hash_chain import DROPPED, NOTHING, AuditRow, Head, Link, checkpoint, row_hash

SUFFIX: Final = ".sqlite"
BROKEN: Final = ".broken-"
"""Part of the name of a file that was moved aside."""
_BUSY_S: Final = 0.5
"""How long one step waits for another process to release the file; a closing writer takes four such steps at most."""
_DAY_NS: Final = 86_400_000_000_000
_COLUMNS: Final = AuditRow.__struct_fields__
_SCHEMA: Final = (
    f"CREATE TABLE IF NOT EXISTS record (seq INTEGER PRIMARY KEY, {', '.join(_COLUMNS[1:])}, before BLOB, hash BLOB)",
    "CREATE TABLE IF NOT EXISTS head (only_one INTEGER PRIMARY KEY CHECK (only_one = 1), seq INTEGER, hash BLOB)",
)
_ADD: Final = (  # by name: a later version may have added columns
    f"INSERT INTO record ({', '.join(_COLUMNS)}, before, hash) VALUES ({', '.join('?' * (len(_COLUMNS) + 2))})"  # noqa: S608 - no words of others
)
_READ: Final = f"SELECT {', '.join(_COLUMNS)}, before, hash FROM record WHERE seq > ? ORDER BY seq"  # noqa: S608

Make = Callable[[Head], Sequence[AuditRow]]
"""Makes the rows to add after a given end."""


class Retention(NamedTuple):
    """The limits for keeping rows of a record."""

    days: int
    rows: int
    least: int = 10_000
    """The number of rows kept whatever their age: a wrong clock must not clear the record."""
    piece: int = 1_000
    """Rows are dropped in pieces of this size, ten pieces at most at once."""


class AuditStore:
    """The audit file of one container, for its writer. Used by one thread.

    Raises:
        sqlite3.OperationalError: the file cannot be written now: no space, no permission, a read-only disk.
        sqlite3.DatabaseError: the file is corrupt.
    """

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        os.close(os.open(path, os.O_CREAT | os.O_RDWR, 0o600))  # SQLite's further files get the same permissions
        self._file = sqlite3.connect(path, timeout=_BUSY_S, isolation_level=None)
        try:
            self._file.execute("PRAGMA journal_mode=WAL")
            self._file.execute("PRAGMA synchronous=FULL")
            with self._transaction():
                for table in _SCHEMA:
                    self._file.execute(table)
                self._file.execute("INSERT OR IGNORE INTO head VALUES (1, 0, ?)", (NOTHING,))
        except BaseException:
            self._file.close()
            raise

    @contextlib.contextmanager
    def _transaction(self) -> Generator[None, None, None]:
        self._file.execute("BEGIN IMMEDIATE")
        try:
            yield
            self._file.execute("COMMIT")
        except BaseException:
            with contextlib.suppress(sqlite3.Error):  # it may have been rolled back already
                self._file.execute("ROLLBACK")
            raise

    def add(self, rows: Sequence[AuditRow]) -> Head:
        """Add rows, all or none; assigns their numbers. Returns the new end. Raises as the class says."""
        with self._transaction():
            return self._append(_head(self._file), rows)

    def _append(self, head: Head, rows: Sequence[AuditRow]) -> Head:
        chained: list[tuple[object, ...]] = []
        for row in rows:
            placed = structs.replace(row, seq=head.seq + 1)
            after = row_hash(head.hash, placed)
            chained.append((*structs.astuple(placed), head.hash, after))
            head = Head(placed.seq, after)
        self._file.executemany(_ADD, chained)
        self._file.execute("UPDATE head SET seq = ?, hash = ?", (head.seq, head.hash))
        return head

    def drop(self, keep: Retention, row: AuditRow) -> int:
        """Drop the oldest rows that need not be kept, and add a row about it. Raises as the class says.

        Args:
            keep: the limits, at the time of ``row``.
            row: the row to add; this method sets ``kind``, ``what`` and ``about``.

        Returns:
            The number of rows dropped; there may be more to drop.
        """
        with self._transaction():
            head = _head(self._file)
            (oldest,) = self._file.execute("SELECT min(seq) FROM record").fetchone()
            if oldest is None:
                return 0
            too_many = head.seq - oldest + 1 - keep.rows
            too_old = self._older(oldest, max(0, row.at_ns - keep.days * _DAY_NS), keep, head)
            pieces = min(10, max(too_many, too_old) // keep.piece)
            if pieces <= 0:
                return 0
            last = oldest + pieces * keep.piece - 1
            (its_hash,) = self._file.execute("SELECT hash FROM record WHERE seq = ?", (last,)).fetchone()
            self._file.execute("DELETE FROM record WHERE seq <= ?", (last,))
            gap = structs.replace(row, kind="audit", what=DROPPED, about=checkpoint(Head(last, its_hash)))
            self._append(head, [gap])
            return pieces * keep.piece

    def _older(self, oldest: int, before_ns: int, keep: Retention, head: Head) -> int:
        """The number of consecutive oldest rows that are older than a moment and may be dropped."""
        most = min(10 * keep.piece, head.seq - oldest + 1 - keep.least)
        if most <= 0:
            return 0
        found = self._file.execute(
            "SELECT min(seq) FROM record WHERE seq < ? AND at_ns >= ?", (oldest + most, before_ns)
        ).fetchone()[0]
        return most if found is None else found - oldest

    def close(self) -> None:
        """Close the file. Idempotent."""
        self._file.close()


def _head(file: sqlite3.Connection) -> Head:
    return Head(*file.execute("SELECT seq, hash FROM head").fetchone())


# --- reading


def records_in(folder: Path) -> list[Path]:
    """The files of a folder of audit records, by name."""
    return sorted(path for path in folder.glob(f"*{SUFFIX}") if path.is_file())


def moved_aside_in(folder: Path) -> list[Path]:
    """The files that were found corrupt."""
    found = folder.glob(f"*{SUFFIX}{BROKEN}*")
    return sorted(path for path in found if not path.name.endswith(("-wal", "-shm")))


@contextlib.contextmanager
def reading(path: Path, after: int = 0) -> Generator[tuple[Head, Iterator[Link]], None, None]:
    """The end of a record, and its rows after one of them, at this moment; writes nothing.

    Raises:
        sqlite3.Error: the file cannot be read, or is corrupt; also while the rows are read.
    """
    file = _opened(path)
    try:
        file.execute("BEGIN")
        yield _head(file), (_link(found) for found in file.execute(_READ, (after,)))
    finally:
        file.close()


def _opened(path: Path) -> sqlite3.Connection:
    """Opens a file for reading; also without permission to write next to it, in the state its container left."""
    file = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True, timeout=_BUSY_S, isolation_level=None)
    try:
        file.execute("SELECT seq FROM head").fetchone()
    except sqlite3.OperationalError:
        file.close()
        return sqlite3.connect(f"{path.absolute().as_uri()}?immutable=1", uri=True, isolation_level=None)
    return file


def _link(found: tuple[object, ...]) -> Link:
    *values, before, after = found
    return Link(AuditRow(*values), before, after)  # type: ignore[arg-type]


def move_aside(path: Path, stamp: str) -> Path:
    """Rename a corrupt file with its further files. Raises OSError."""
    aside = path.with_name(f"{path.name}{BROKEN}{stamp}")
    path.replace(aside)
    for part in ("-wal", "-shm"):
        with contextlib.suppress(FileNotFoundError):
            path.with_name(f"{path.name}{part}").replace(aside.with_name(f"{aside.name}{part}"))
    return aside
