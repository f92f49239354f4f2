"""The hash chain of an audit record: each row contains the hash of the previous one, so that no row changes unnoticed.

Pure: rows in, a verdict out. Decision 36 describes what a chain can prove, and what it cannot.
"""

import hashlib
from collections.abc import Iterable, Mapping
from typing import Final

import msgspec
from msgspec import Struct, structs

NOTHING: Final = bytes(32)
"""The previous hash of the first row."""
DROPPED: Final = "dropped"
"""The event of a row of kind ``audit`` for dropped rows; it names the last of them, see `checkpoint`."""
_FORMAT: Final = b"trade audit 1\0"
_NEAR: Final = 1000
"""The distance within which the origin of a moved row is searched."""
_ANOTHER: Final = "it is not the row that was noted elsewhere: it, or an earlier one, was rewritten"
_encode: Final = msgspec.msgpack.Encoder().encode


class AuditRow(Struct, frozen=True, array_like=True, gc=False):
    """One row of a record, as it is written and hashed: the order of the fields is part of the format."""

    seq: int
    """Counts the rows of a record, from 1."""
    at_ns: int
    """``time.time_ns()`` of the host."""
    monotonic_ns: int
    boot: str
    """Epoch of the container that wrote it; a restart begins a new one."""
    kind: str
    what: str
    about: str
    who: str
    session: str
    call_id: int
    outer_id: int
    outcome: str
    why: str
    took_ns: int


class Link(Struct, frozen=True, gc=False):
    """A row with its own hash and the previous one, as they were read."""

    row: AuditRow
    before: bytes
    hash: bytes


class Head(Struct, frozen=True):
    """The end of a record."""

    seq: int
    hash: bytes


class ChainCheck(Struct, frozen=True, kw_only=True):
    """The result of a check of a record."""

    rows: int = 0
    first: int = 0
    """The oldest row present; if it is not 1, older rows were dropped in order."""
    head: Head = Head(0, NOTHING)
    """The newest row present."""
    broken_at: int = 0
    """The first row that was changed or is missing; 0: none."""
    problem: str = ""
    """The problem with that row; empty: none."""
    proven: int = 0
    """The newest row noted elsewhere that matches, or matched when it was dropped; 0: none."""
    untold: tuple[int, ...] = ()
    """Dropped rows, noted elsewhere, that no remaining row names: they can no longer be checked."""


def row_hash(before: bytes, row: AuditRow) -> bytes:
    """SHA-256 of a row and the hash of the previous one."""
    return hashlib.sha256(_FORMAT + before + _encode(row)).digest()


def checkpoint(head: Head) -> str:
    """The text of a row about dropped rows: the last of them."""
    return f"{head.seq} {head.hash.hex()}"


def verify(links: Iterable[Link], head: Head, witnessed: Mapping[int, bytes] | None = None) -> ChainCheck:
    """Check a record from its oldest row to its newest.

    Args:
        links: its rows, in the order of their numbers.
        head: the end according to the record itself.
        witnessed: hashes of rows by number, as noted elsewhere.
    """
    witnessed, rows, first, begins = witnessed or {}, 0, 0, ""
    dropped: list[str] = []
    last = Head(0, NOTHING)
    broken_at, problem = 0, ""
    for link in links:
        row = link.row
        if not first:
            first, last = row.seq, Head(row.seq - 1, link.before)
            begins = checkpoint(last)
        broken_at, problem = _wrong_row(link, last, witnessed)
        if problem:
            break
        rows, last = rows + 1, Head(row.seq, link.hash)
        if row.kind == "audit" and row.what == DROPPED:
            dropped.append(row.about)
    if not problem:
        broken_at, problem = _wrong_end(last, head, witnessed)
    if not problem and first > 1 and dropped[-1:] != [begins]:
        broken_at, problem = 1, f"rows 1 to {first - 1} are missing, and no row says that just these were dropped"
    if problem:
        return ChainCheck(rows=rows, first=first, head=last, broken_at=broken_at, problem=problem)
    matched = _dropped_before(first, dropped, witnessed)
    broken_at, problem = next(((seq, _ANOTHER) for seq, right in matched.items() if not right), (0, ""))
    untold = tuple(sorted(seq for seq in witnessed if seq < first and seq not in matched))
    return ChainCheck(
        rows=rows,
        first=first,
        head=last,
        broken_at=broken_at,
        problem=problem,
        proven=max((seq for seq in witnessed if seq not in untold), default=0),
        untold=untold,
    )


def _dropped_before(first: int, dropped: Iterable[str], witnessed: Mapping[int, bytes]) -> dict[int, bool]:
    """Whether dropped rows matched the noted ones, as far as the rows about dropping name them."""
    named = {about.partition(" ")[0]: about for about in dropped}
    gone = {seq: noted for seq, noted in witnessed.items() if seq < first and str(seq) in named}
    return {seq: named[str(seq)] == checkpoint(Head(seq, noted)) for seq, noted in sorted(gone.items())}


def _wrong_row(link: Link, last: Head, witnessed: Mapping[int, bytes]) -> tuple[int, str]:
    """The first problem with a row after another one, and its place."""
    seq = link.row.seq
    if seq != last.seq + 1:
        return last.seq + 1, f"rows {last.seq + 1} to {seq - 1} are missing"
    if row_hash(link.before, link.row) != link.hash:
        return seq, _changed(link)
    if link.before != (NOTHING if seq == 1 else last.hash):
        return seq, "it does not follow from the row before: one of them was replaced"
    if witnessed.get(seq, link.hash) != link.hash:
        return seq, _ANOTHER
    return 0, ""


def _wrong_end(last: Head, head: Head, witnessed: Mapping[int, bytes]) -> tuple[int, str]:
    """The problem with the end of the rows, and its place."""
    if last.seq < head.seq:
        return last.seq + 1, f"rows {last.seq + 1} to {head.seq} are missing, at the end"
    if last != head:
        return head.seq + 1, f"it is beyond row {head.seq}, where the record ends"
    if (noted := max(witnessed, default=0)) > last.seq:
        return last.seq + 1, f"row {noted} was noted elsewhere, and the record ends at {last.seq}"
    return 0, ""


def _changed(link: Link) -> str:
    seq = link.row.seq
    for place in range(max(1, seq - _NEAR), seq + _NEAR):
        if row_hash(link.before, structs.replace(link.row, seq=place)) == link.hash:
            return f"it was row {place}: rows were put into another order, or others in between"
    return "it was changed"
