"""The faults of a robot on disk, so that they outlive the process."""

import sqlite3
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Final

import msgspec

from trade.keeping import Database
from trade_drivers.faults._record import Fault

__all__ = ["FaultStore", "Kept", "Key"]

Key = tuple[str, str]
"""Device and kind."""
Kept = tuple[int, Fault]
"""Which began later has the greater number."""

_TABLE: Final = """
create table if not exists fault (
  device text not null, kind text not null, number integer not null, blob blob not null, primary key (device, kind)
)
"""
_SAVE: Final = "insert or replace into fault (device, kind, number, blob) values (?, ?, ?, ?)"
_DROP: Final = "delete from fault where device = ? and kind = ?"
_LOAD: Final = "select number, blob from fault order by number"


class FaultStore(Database):
    """One file with the faults of one robot.

    Args:
        path: of the file; its folder is made.
        tell: is told what is wrong with it, and when it is not any more.
    """

    def __init__(self, path: Path, tell: Callable[[str], None]) -> None:
        super().__init__(path, _TABLE, "fault", tell)

    def load(self) -> list[Kept]:
        """What was saved, the oldest first; nothing if there is none to be had. Takes 10 s at most."""

        def load(database: sqlite3.Connection) -> list[Kept]:
            found = database.execute(_LOAD).fetchall()
            return [(number, msgspec.msgpack.decode(blob, type=Fault)) for number, blob in found]

        return self._ask(load, default=[])

    def save(self, kept: Sequence[Kept], dropped: Iterable[Key]) -> "Future[bool]":
        """Write these anew, and forget those, all or nothing, without waiting; whether that could be done."""
        gone = list(dropped)

        def save(database: sqlite3.Connection) -> bool:
            rows = [(fault.device, fault.kind, number, msgspec.msgpack.encode(fault)) for number, fault in kept]
            with database:
                database.executemany(_DROP, gone)
                database.executemany(_SAVE, rows)
            return True

        return self._start(save, default=False)
