"""What planners of the siege note, and what is done to whom: a JSON line each, on a clock that all processes share."""

import os
from collections.abc import Iterator
from pathlib import Path

import msgspec


class Record(msgspec.Struct, tag_field="kind", tag=str.lower, frozen=True, kw_only=True):
    """One line."""

    t: float


class Ask(Record):
    """A planner is about to ask for a lock."""

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


class Order(Record):
    """It is about to have a joint moved to there."""

    number: str
    hold: str
    resource: str
    counts: int
    deadline_s: float


class Answer(Record):
    """What it was told of that."""

    number: str
    how: str


class Fault(Record):
    """Something was done, to whom, and how long it lasted."""

    what: str
    whom: str
    until: float


AnyRecord = Ask | Held | Seen | Done | Order | Answer | Fault
_encode = msgspec.json.Encoder().encode


class Log:
    """A file of one process. A line is whole or not there, also after kill -9."""

    def __init__(self, folder: Path | str, process: str) -> None:
        path = Path(folder) / f"{process}.jsonl"
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o600)

    def note(self, record: Record) -> None:
        os.write(self._fd, _encode(record) + b"\n")

    def close(self) -> None:
        os.close(self._fd)


def read(folder: Path) -> Iterator[AnyRecord]:
    """Every record of a run; the order is that of the files."""
    decode = msgspec.json.Decoder(AnyRecord).decode
    for path in sorted(folder.glob("*.jsonl")):
        yield from map(decode, path.read_bytes().splitlines())
