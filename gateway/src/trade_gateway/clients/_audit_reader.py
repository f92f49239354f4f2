"""What is on record on this host: the newest rows of the audit records that containers keep in one folder."""

import heapq
import sqlite3
from collections.abc import Iterator
from pathlib import Path

import msgspec

from trade.auditing import AuditRow, reading, records_in
from trade.errors import ConfigurationError
from trade_gateway.clients._schemas import AuditView


def newest(folder: Path, most: int) -> list[AuditView]:
    """The newest rows of all records, the newest first.

    Raises:
        ConfigurationError: one of them cannot be read.
    """
    found = [_view(path.stem, row) for path in records_in(folder) for row in _last(path, most)]
    return heapq.nlargest(most, found, key=lambda view: view.at)


def _last(path: Path, most: int) -> Iterator[AuditRow]:
    try:
        with reading(path) as (end, _):
            after = max(0, end.seq - most)
        with reading(path, after) as (_, links):
            yield from (link.row for link in links)
    except (sqlite3.Error, msgspec.ValidationError) as bad:
        raise ConfigurationError(where=str(path), problem=f"cannot be read: {bad}") from None


def _view(container: str, row: AuditRow) -> AuditView:
    return AuditView(
        at=row.at_ns / 1e9,
        container=container,
        kind=row.kind,
        what=row.what,
        about=row.about,
        who=row.who,
        session=row.session,
        outcome=row.outcome,
        why=row.why,
        call_id=str(row.call_id),
    )
