"""The faults of a robot on disk (SQLite), so that they outlive the process."""

import sqlite3
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Final

import msgspec

from trade.storage import Database
from trade_drivers.faults._record import Fault

Key = tuple[str, str]
"""Device and kind."""
Kept = tuple[int, Fault]
"""A number in the order of the faults' beginning, and the fault."""

_TABLE: Final = """
create table if not exists fault (
  device text not null, kind text not null, number integer not null, blob blob not null, primary key (device, kind)
)
"""
_SAVE: Final = "insert or replace into fault (device, kind, number, blob) values (?, ?, ?, ?)"
_DROP: Final = "delete from fault where device = ? and kind = ?"
_LOAD: Final = "select number, blob from fault order by number"


class FaultStore(Database):
    """The database with the faults of one robot.

    Args:
        path: of the file; its folder is created.
        tell: called when the file cannot be used, and when it can again.
    """

    def __init__(self, path: Path, tell: Callable[[str], None]) -> None:
        super().__init__(path, _TABLE, "fault", tell)

    def load(self) -> list[Kept]:
        """Returns the saved faults, oldest first; none if the file cannot be read. Takes 10 s at most."""

        def load(database: sqlite3.Connection) -> list[Kept]:
            found = database.execute(_LOAD).fetchall()
            return [(number, msgspec.msgpack.decode(blob, type=Fault)) for number, blob in found]

        return self._ask(load, default=[])

    def save(self, kept: Sequence[Kept], dropped: Iterable[Key]) -> "Future[bool]":
        """Writes and deletes faults in one transaction without waiting; the future says whether it succeeded."""
        gone = list(dropped)

        def save(database: sqlite3.Connection) -> bool:
            rows = [(fault.device, fault.kind, number, msgspec.msgpack.encode(fault)) for number, fault in kept]
            with database:
                database.executemany(_DROP, gone)
                database.executemany(_SAVE, rows)
            return True

        return self._start(save, default=False)
