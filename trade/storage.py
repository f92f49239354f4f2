"""One SQLite file, and the one thread that uses it: a disk error stops only the saving."""

import contextlib
import sqlite3
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as TookTooLong  # the builtin one from 3.11 on
from pathlib import Path
from typing import Final, TypeVar

import msgspec

_WAIT_S: Final = 10.0
"""How long to wait for the disk."""
_BESIDE: Final = ("", "-wal", "-shm")
"""Suffixes of the database's files."""

_Result = TypeVar("_Result")


class Database:
    """The base class of a database in one file.

    It reports a disk error once, and the recovery once. A file that is not a valid database is renamed, and a new one
    is created.

    Args:
        path: of the file; its folder is created.
        table: the statement that creates its table if it does not exist.
        what: its contents in one word, for messages.
        tell: called with a message about each error and each recovery.
    """

    def __init__(self, path: Path, table: str, what: str, tell: Callable[[str], None]) -> None:
        self._path = path
        self._table = table
        self._what = what
        self._tell = tell
        self._thread = ThreadPoolExecutor(1, f"trade-{what}s")
        self._open: sqlite3.Connection | None = None
        self._trouble = ""

    def close(self) -> None:
        """End its thread. Idempotent."""
        with contextlib.suppress(RuntimeError):  # it ended already
            self._thread.submit(self._close_file)
        self._thread.shutdown()

    def _ask(self, what: Callable[[sqlite3.Connection], _Result], *, default: _Result) -> _Result:
        """The result of a function on the database, or the default if the disk does not respond in time."""
        try:
            return self._start(what, default=default).result(_WAIT_S)
        except (TookTooLong, RuntimeError):  # RuntimeError: it was closed meanwhile
            return default

    def _start(self, what: Callable[[sqlite3.Connection], _Result], *, default: _Result) -> "Future[_Result]":
        """Run a function on the database without waiting; RuntimeError if it is closed."""
        return self._thread.submit(self._do, what, default)

    # --- on its thread

    def _do(self, what: Callable[[sqlite3.Connection], _Result], default: _Result) -> _Result:
        try:
            result = self._tried(what)
        except (sqlite3.Error, OSError) as wrong:
            self._close_file()
            if not self._trouble:
                self._trouble = str(wrong)
                self._tell(f"no {self._what} is saved: {self._path}: {wrong}. Everything else continues")
            return default
        if self._trouble:
            self._trouble = ""
            self._tell(f"{self._what} is saved again: {self._path}")
        return result

    def _tried(self, what: Callable[[sqlite3.Connection], _Result]) -> _Result:
        try:
            return what(self._opened())
        except sqlite3.OperationalError:  # a disk error, not a damaged file
            raise
        except (sqlite3.DatabaseError, msgspec.DecodeError) as corrupt:
            self._close_file()
            aside = self._move_aside()
            self._tell(f"{self._path} is corrupt ({corrupt}): it is {aside.name} now; its contents are not restored")
            return what(self._opened())

    def _opened(self) -> sqlite3.Connection:
        if self._open is None:
            self._path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            self._open = sqlite3.connect(self._path, timeout=_WAIT_S / 2)
            self._open.execute("pragma journal_mode = wal")
            self._open.execute("pragma synchronous = full")
            [[result]] = self._open.execute("pragma quick_check(1)").fetchall()
            if result != "ok":
                raise sqlite3.DatabaseError(result)
            self._open.execute(self._table)
            self._path.chmod(0o600)
        return self._open

    def _move_aside(self) -> Path:
        number = 1
        while (aside := self._path.with_name(f"{self._path.name}.corrupt-{number}")).exists():
            number += 1
        for end in _BESIDE:
            with contextlib.suppress(FileNotFoundError):
                self._path.with_name(self._path.name + end).replace(aside.with_name(aside.name + end))
        return aside

    def _close_file(self) -> None:
        if self._open is not None:
            with contextlib.suppress(sqlite3.Error):
                self._open.close()
            self._open = None
