"""The state store: the last complete save of each provider on disk, safe against a crash of this process."""

import sqlite3
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import msgspec

from trade.storage import Database

_TABLE: Final = """
create table if not exists state (
  container text not null, object text not null, saved_at real not null, blob blob not null,
  primary key (container, object)
)
"""
_SAVE: Final = "insert or replace into state (container, object, saved_at, blob) values (?, ?, ?, ?)"
_LOAD: Final = "select object, blob from state where container = ?"


class StateStore(Database):
    """A database with the states of all objects.

    Args:
        path: the file; its folder is created.
        callback: called with a problem, and with its end.
    """

    def __init__(self, path: Path, callback: Callable[[str], None]) -> None:
        super().__init__(path, _TABLE, "state", callback)

    def save(self, container: str, states: Mapping[str, Any], wanted: Callable[[], bool] = lambda: True) -> bool:
        """Saves the states of a container's objects, all or none; returns whether they are on disk.

        Args:
            container: the container's name.
            states: the states by object name.
            wanted: called immediately before the save, after all earlier saves and loads.
        """
        rows = [(container, name, time.time(), msgspec.msgpack.encode(state)) for name, state in states.items()]

        def save(database: sqlite3.Connection) -> bool:
            if not wanted():
                return False
            with database:
                database.executemany(_SAVE, rows)
            return True

        return self._ask(save, default=False)

    def load(self, container: str) -> dict[str, Any]:
        """Returns the last saved states of a container's objects; empty if there are none."""

        def load(database: sqlite3.Connection) -> dict[str, Any]:
            found = database.execute(_LOAD, (container,)).fetchall()
            return {name: msgspec.msgpack.decode(blob) for name, blob in found}

        return self._ask(load, default={})
