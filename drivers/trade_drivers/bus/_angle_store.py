"""The last known angles of a robot's joints on disk (SQLite), so that they outlive the process."""

import sqlite3
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future
from math import isfinite
from pathlib import Path
from typing import Final

from trade.errors import ConfigurationError
from trade.storage import Database

Span = tuple[float, float]
"""Where a joint is, in rad; its two ends differ while it moves."""

_TABLE: Final = "create table if not exists angle (joint text primary key, low_rad real, high_rad real)"
_SAVE: Final = "insert or replace into angle (joint, low_rad, high_rad) values (?, ?, ?)"
_LOAD: Final = "select joint, low_rad, high_rad from angle"


class AngleStore(Database):
    """The database with the last known angle of each joint of one robot.

    Args:
        path: of the file; its folder is created.
        tell: called when the file cannot be used, and when it can again.
    """

    def __init__(self, path: Path, tell: Callable[[str], None]) -> None:
        super().__init__(path, _TABLE, "angle", tell)
        self._file = path

    def load(self) -> dict[str, Span]:
        """Returns where the joints were, by name; none if the file cannot be read. Takes 10 s at most.

        Raises:
            ConfigurationError: an angle in the file is none.
        """

        def load(database: sqlite3.Connection) -> dict[str, Span]:
            return {joint: (low, high) for joint, low, high in database.execute(_LOAD).fetchall()}

        known = self._ask(load, default={})
        for joint, span in known.items():
            if not (all(isinstance(end, float) and isfinite(end) for end in span) and span[0] <= span[1]):
                problem = (
                    f"the last known angle of {joint} is {span[0]!r} to {span[1]!r} rad, which is none. Delete this "
                    "file, and compare `state()` with the place of each joint before you enable it"
                )
                raise ConfigurationError(where=str(self._file), problem=problem)
        return known

    def save(self, angles: Mapping[str, Span]) -> "Future[bool]":
        """Writes angles in one transaction without waiting; the future says whether it succeeded."""
        rows: Iterable[tuple[str, float, float]] = [(joint, *span) for joint, span in angles.items()]

        def save(database: sqlite3.Connection) -> bool:
            with database:
                database.executemany(_SAVE, rows)
            return True

        return self._start(save, default=False)
