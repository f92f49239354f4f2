"""What clients of locks note as it happens, and who had what: for the judges of the chaos and of the siege.

A note is a line of JSON, on one clock for all processes of a machine.
"""

import os
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from msgspec import Struct


class Record(Struct, tag_field="kind", tag=str.lower, frozen=True, kw_only=True):
    """One line."""

    t: float


class Ask(Record):
    """A client is about to ask for a lock."""

    hold: str
    resources: tuple[str, ...]


class Held(Record):
    """It has it."""

    hold: str


class Seen(Record):
    """It still had it."""

    hold: str


class Done(Record):
    """It was refused, gave it back or lost it."""

    hold: str
    how: str


class Log:
    """A file of one process. A line is whole or not there, also after kill -9."""

    def __init__(self, folder: Path | str, process: str) -> None:
        path = Path(folder) / f"{process}-{os.getpid()}.jsonl"
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o600)

    def note(self, record: Record) -> None:
        os.write(self._fd, msgspec.json.encode(record) + b"\n")

    def close(self) -> None:
        os.close(self._fd)


def now() -> float:
    return time.monotonic()


def read(folder: Path, kinds: Any) -> Iterator[Any]:
    """Every record of a run, of these kinds; the order is that of the files."""
    decode = msgspec.json.Decoder(kinds).decode
    for path in sorted(folder.glob("*.jsonl")):
        yield from map(decode, path.read_bytes().splitlines())


@dataclass
class Verdict:
    """What a run was, and what was wrong."""

    counts: Counter[str] = field(default_factory=Counter)
    violations: list[str] = field(default_factory=list)


class Owned(NamedTuple):
    """From when to when an owner certainly had a resource, as far as it knew."""

    hold: str
    since: float
    until: float


def by_kind(records: Iterable[Record]) -> dict[type, list[Any]]:
    """The records of each kind."""
    known: dict[type, list[Any]] = defaultdict(list)
    for record in records:
        known[type(record)].append(record)
    return known


def owned(known: Mapping[type, list[Any]]) -> dict[str, list[Owned]]:
    """By resource: who surely had it when."""
    resources = {ask.hold: ask.resources for ask in known[Ask]}
    last: dict[str, float] = {}
    for seen in known[Seen]:
        last[seen.hold] = max(seen.t, last.get(seen.hold, seen.t))
    found: dict[str, list[Owned]] = defaultdict(list)
    for held in known[Held]:
        for resource in resources[held.hold]:
            found[resource].append(Owned(held.hold, held.t, max(held.t, last.get(held.hold, held.t))))
    for spans in found.values():
        spans.sort(key=lambda span: span.since)
    return found


def two_owners(owned: Mapping[str, Sequence[Owned]]) -> list[str]:
    """Where two had the same at once."""
    found: list[str] = []
    for resource, spans in owned.items():
        latest: Owned | None = None
        for span in spans:
            if latest is not None and span.since < latest.until:
                found.append(f"{resource} has two owners at {span.since:.6f}: {latest.hold} and {span.hold}")
            if latest is None or span.until > latest.until:
                latest = span
    return found


def asks_without_end(known: Mapping[type, list[Any]], killed: set[str]) -> list[str]:
    """Who asked for a lock and never heard anything, unless its process was killed: names of holds begin with that."""
    answered = {record.hold for kind in (Held, Done) for record in known[kind]}
    waiting = [ask for ask in known[Ask] if ask.hold not in answered and ask.hold.split(":")[0] not in killed]
    return [f"{ask.hold} asked at {ask.t:.6f} and never heard anything" for ask in waiting]
