"""``trade audit``: shows and verifies the audit records of this host."""

import fnmatch
import heapq
import re
import sqlite3
import threading
import time
from collections.abc import Iterator, Mapping
from datetime import datetime
from pathlib import Path
from typing import Annotated, Final, Literal, NamedTuple

import msgspec
import typer
from rich.markup import escape

from trade.auditing import AuditRow, ChainCheck, moved_aside_in, reading, records_in, verify
from trade.errors import ConfigurationError
from trade.protocol.keys import client_of
from trade_gateway._usage import UsageError
from trade_gateway.terminal._options import FirstByDefault, Json
from trade_gateway.terminal._output import Output, complain

_EVERY_S: Final = 0.5
_UNITS_S: Final = {"s": 1, "m": 60, "h": 3600, "d": 86_400}
_FILTERS: Final = "Filters"
_AGO: Final = re.compile(r"(\d+)([smhd])")

Folder = Annotated[
    Path, typer.Argument(metavar="FOLDER", envvar="TRADE_AUDIT", help="Folder of the containers' records.")
]


app = typer.Typer(
    cls=FirstByDefault,
    help="Show and verify the audit record. Default: show.\n\nFor example: trade audit /var/lib/trade/audit --since 1h",
)


class ContainerAuditRow(NamedTuple):
    """A row of the audit record of a container."""

    container: str
    row: AuditRow


@app.command()
def show(
    folder: Folder,
    since: Annotated[str, typer.Option(rich_help_panel=_FILTERS, help="Age (30m, 12h, 7d) or 2026-11-21T08:00.")] = "",
    who: Annotated[
        str, typer.Option(rich_help_panel=_FILTERS, help="Identity or client; * and ? are wildcards.")
    ] = "*",
    service: Annotated[str, typer.Option(rich_help_panel=_FILTERS, help="Service; * and ? are wildcards.")] = "*",
    container: Annotated[str, typer.Option(rich_help_panel=_FILTERS, help="Container; * and ? are wildcards.")] = "*",
    kind: Annotated[
        Literal["call", "read", "stop", "lock", "configure", "refused", "audit"] | None,
        typer.Option(rich_help_panel=_FILTERS, help="Kind of row."),
    ] = None,
    call: Annotated[
        int | None, typer.Option(rich_help_panel=_FILTERS, help="Id of a call; also shows the calls that it led to.")
    ] = None,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Keep printing new rows until Ctrl-C.")] = False,
    as_json: Json = False,
) -> None:
    """Show the audit rows of a folder in order of time.

    For example: trade audit /var/lib/trade/audit --since 1h --kind refused
    """
    out, pause, after_ns = Output(as_json=as_json), threading.Event(), _moment(since)
    seen: dict[Path, int] = {}
    while True:
        found = [_rows(path, seen) for path in _records(folder, missing_is_wrong=not follow)]
        for entry in heapq.merge(*found, key=lambda entry: entry.row.at_ns):
            row = entry.row
            meant = row.at_ns >= after_ns and kind in (None, row.kind) and call in (None, row.call_id, row.outer_id)
            patterns = ((row.what, service), (entry.container, container))
            meant = meant and any(fnmatch.fnmatchcase(name, who) for name in (row.who, client_of(row.session)))
            if meant and all(fnmatch.fnmatchcase(text, pattern) for text, pattern in patterns):
                _say(out, entry)
        if not follow:
            return
        pause.wait(_EVERY_S)


@app.command("verify")
def verify_command(
    folder: Folder,
    against: Annotated[
        Path | None, typer.Option(help="Earlier output of `trade audit head --json`, kept out of reach of this host.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Check that no row was changed, removed, added or moved.

    The exit code is 1 if one was, and the first such row is printed.
    With --against, it is 3 if a record cannot be compared because all noted rows were dropped since.

    For example: trade audit verify /var/lib/trade/audit --against /media/stick/heads
    """
    out, noted = Output(as_json=as_json), {} if against is None else _noted(against)
    bad = unproven = 0
    for path in _records(folder):
        verdict = _verified(path, noted.pop(path.stem, {}))
        bad += bool(verdict.problem)
        unproven += bool(verdict.untold and not verdict.proven)
        if as_json:
            out.data({"container": path.stem, "ok": not verdict.problem, **_verdict_data(verdict)})
        out.say(_sentence(path, verdict))
        for seq in verdict.untold:
            dropped = f"row {seq} was noted elsewhere and dropped since, so it cannot be compared"
            out.say(f"[bold yellow]{escape(path.stem)}[/]: {dropped}")
    for name in noted:
        bad += 1
        out.say(f"[bold red]{escape(name)}[/]: noted elsewhere, but it has no record here")
        if as_json:
            out.data({"container": name, "ok": False, "problem": "it has no record here"})
    for path in moved_aside_in(folder):
        bad += 1
        out.say(f"[bold red]{escape(path.name)}[/]: was found damaged and moved aside")
        if as_json:
            out.data({"container": path.stem, "ok": False, "problem": f"{path.name} was found damaged and moved aside"})
    if bad or unproven:
        raise typer.Exit(1 if bad else 3)


@app.command()
def head(folder: Folder, as_json: Json = False) -> None:
    """Print the last row and hash of each record.

    Keep them on another host: then `trade audit verify --against` detects changes of any row up to there.

    For example: trade audit head /var/lib/trade/audit --json > /media/stick/heads
    """
    out = Output(as_json=as_json)
    for path in _records(folder):
        try:
            with reading(path) as (end, _):
                pass
        except sqlite3.Error as bad:
            raise ConfigurationError(where=str(path), problem=f"cannot be read: {bad}") from None
        if as_json:
            out.data({"container": path.stem, "seq": end.seq, "hash": end.hash.hex()})
        out.say(f"{escape(path.stem)}: row {end.seq}, {end.hash.hex()}")


# --- reading


def _records(folder: Path, *, missing_is_wrong: bool = True) -> list[Path]:
    found = records_in(folder) if folder.is_dir() else []
    if not found and missing_is_wrong:
        raise ConfigurationError(
            where=str(folder), problem=f"has no audit record; containers write one with TRADE_AUDIT={folder}"
        )
    return found


def _rows(path: Path, seen: dict[Path, int]) -> Iterator[ContainerAuditRow]:
    """Returns the rows that were not seen yet."""
    try:
        with reading(path, seen.get(path, 0)) as (end, links):
            if end.seq < seen.get(path, 0):  # the record was started again
                seen[path] = 0
            for link in links:
                seen[path] = link.row.seq
                yield ContainerAuditRow(path.stem, link.row)
    except (sqlite3.Error, msgspec.ValidationError) as bad:
        complain(f"{path} cannot be read: {bad}")


def _verified(path: Path, noted: Mapping[int, bytes]) -> ChainCheck:
    try:
        with reading(path) as (end, links):
            return verify(links, end, noted)
    except (sqlite3.Error, TypeError) as bad:
        return ChainCheck(broken_at=1, problem=f"it cannot be read: {bad}")


class _NotedHead(msgspec.Struct):
    container: str
    seq: int
    hash: str


def _noted(file: Path) -> dict[str, dict[int, bytes]]:
    """Returns hashes of rows by container and number."""
    found: dict[str, dict[int, bytes]] = {}
    try:
        for line in file.read_bytes().splitlines():
            noted = msgspec.json.decode(line, type=_NotedHead)
            found.setdefault(noted.container, {})[noted.seq] = bytes.fromhex(noted.hash)
    except (OSError, ValueError, RecursionError) as bad:
        raise UsageError(where=f"--against {file}", problem=str(bad)) from None
    return found


def _moment(since: str) -> int:
    """Returns the time in nanoseconds since the Unix epoch."""
    if not since:
        return 0
    if ago := _AGO.fullmatch(since):
        return time.time_ns() - int(ago.group(1)) * _UNITS_S[ago.group(2)] * 1_000_000_000
    try:
        return int(datetime.fromisoformat(since).astimezone().timestamp() * 1e9)
    except ValueError:
        raise UsageError(where=f"--since {since}", problem="is neither 30m, 12h, 7d nor 2026-11-21T08:00") from None


# --- output


def _say(out: Output, entry: ContainerAuditRow) -> None:
    row = entry.row
    if out.as_json:
        out.data({"container": entry.container, **msgspec.structs.asdict(row)})
        return
    at = datetime.fromtimestamp(row.at_ns / 1e9).astimezone().isoformat(" ", "milliseconds")[:23]
    end = "" if row.outcome == "ok" else f" {row.outcome}"
    about = f" {row.about}" if row.about else ""
    why = f": {row.why}" if row.why else ""
    began = f" of {row.outer_id}" if row.outer_id != row.call_id else ""
    call = f"  (call {row.call_id}{began})" if row.call_id else ""
    client = client_of(row.session)
    who = f"{row.who} for {client}" if client else row.who or "-"
    out.say(escape(f"{at} {row.kind:9} {entry.container}: {who} {row.what}{about}{end}{why}{call}"))


def _verdict_data(verdict: ChainCheck) -> dict[str, object]:
    return {
        "rows": verdict.rows,
        "first": verdict.first,
        "last": verdict.head.seq,
        "hash": verdict.head.hash.hex(),
        "broken_at": verdict.broken_at,
        "problem": verdict.problem,
        "proven": verdict.proven,
        "untold": verdict.untold,
    }


def _sentence(path: Path, verdict: ChainCheck) -> str:
    name = escape(path.stem)
    if verdict.problem:
        return f"[bold red]{name}[/]: row {verdict.broken_at}: {escape(verdict.problem)}"
    dropped = "" if verdict.first <= 1 else f"; rows before {verdict.first} were dropped in order"
    end = f"row {verdict.head.seq} is {verdict.head.hash.hex()}"
    return f"[bold green]{name}[/]: {verdict.rows} rows, each follows from the one before{dropped}; {end}"
