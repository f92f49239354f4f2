"""What providers remembered, on disk: the last complete save of each survives whatever ends this process."""

import contextlib
import sqlite3
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures import TimeoutError as TookTooLong  # the builtin one from 3.11 on
from pathlib import Path
from typing import Any, Final, TypeVar

import msgspec

__all__ = ["StateStore"]

_WAIT_S: Final = 10.0
"""How long the disk may take."""
_TABLE: Final = """
create table if not exists state (
  container text not null, object text not null, saved_at real not null, blob blob not null,
  primary key (container, object)
)
"""
_SAVE: Final = "insert or replace into state values (?, ?, ?, ?)"
_LOAD: Final = "select object, blob from state where container = ?"
_BESIDE: Final = ("", "-wal", "-shm")
"""Of the file's name, what else belongs to it."""

_Result = TypeVar("_Result")


class StateStore:
    """One SQLite file, and the one thread that uses it.

    Without its disk all goes on but the saving: what is wrong is told once, and when it is well again.

    Args:
        path: of the file; its folder is made.
        tell: is told what is wrong, and when it is not any more.
    """

    def __init__(self, path: Path, tell: Callable[[str], None]) -> None:
        self._path = path
        self._tell = tell
        self._thread = ThreadPoolExecutor(1, "trade-states")
        self._open: sqlite3.Connection | None = None
        self._trouble = ""

    def save(self, container: str, states: Mapping[str, Any]) -> bool:
        """Keep the states of objects of one container, all or none; returns whether they are on disk."""
        rows = [(container, name, time.time(), msgspec.msgpack.encode(state)) for name, state in states.items()]

        def save(database: sqlite3.Connection) -> bool:
            with database:
                database.executemany(_SAVE, rows)
            return True

        return self._ask(save, default=False)

    def load(self, container: str) -> dict[str, Any]:
        """The states of a container's objects as they were saved last; nothing if there are none to be had."""

        def load(database: sqlite3.Connection) -> dict[str, Any]:
            found = database.execute(_LOAD, (container,)).fetchall()
            return {name: msgspec.msgpack.decode(blob) for name, blob in found}

        return self._ask(load, default={})

    def close(self) -> None:
        """End its thread. Idempotent."""
        with contextlib.suppress(RuntimeError):  # it has ended already
            self._thread.submit(self._let_go)
        self._thread.shutdown()

    def _ask(self, what: Callable[[sqlite3.Connection], _Result], *, default: _Result) -> _Result:
        try:
            return self._thread.submit(self._do, what, default).result(_WAIT_S)
        except (TookTooLong, RuntimeError):  # the latter: it was closed meanwhile
            return default

    # --- on its thread

    def _do(self, what: Callable[[sqlite3.Connection], _Result], default: _Result) -> _Result:
        try:
            result = self._tried(what)
        except (sqlite3.Error, OSError) as wrong:
            self._let_go()
            if not self._trouble:
                self._trouble = str(wrong)
                self._tell(f"no state is saved: {self._path}: {wrong}; all else goes on")
            return default
        if self._trouble:
            self._trouble = ""
            self._tell(f"state is saved again: {self._path}")
        return result

    def _tried(self, what: Callable[[sqlite3.Connection], _Result]) -> _Result:
        try:
            return what(self._opened())
        except sqlite3.OperationalError:  # the disk, not what is on it
            raise
        except (sqlite3.DatabaseError, msgspec.DecodeError) as corrupt:
            self._let_go()
            aside = self._move_aside()
            self._tell(f"{self._path} is corrupt ({corrupt}) and is {aside.name} now; what it held is not restored")
            return what(self._opened())

    def _opened(self) -> sqlite3.Connection:
        if self._open is None:
            self._path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            self._open = sqlite3.connect(self._path, timeout=_WAIT_S / 2)
            self._open.execute("pragma journal_mode = wal")
            self._open.execute("pragma synchronous = full")
            [[said]] = self._open.execute("pragma quick_check(1)").fetchall()
            if said != "ok":
                raise sqlite3.DatabaseError(said)
            self._open.execute(_TABLE)
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

    def _let_go(self) -> None:
        if self._open is not None:
            with contextlib.suppress(sqlite3.Error):
                self._open.close()
            self._open = None
