"""What every process notes down as it happens: a JSON line each, on one clock for all processes of a machine."""

import os
import time
from collections.abc import Iterator
from pathlib import Path

import msgspec
from msgspec import Struct


class Record(Struct, tag_field="kind", tag=str.lower, frozen=True, kw_only=True):
    """One line."""

    t: float


# --- what a client believes


class Ask(Record):
    """It is about to ask for a lock."""

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


# --- what happens at a driver


class Command(Record):
    """The gate let a command through; the time is that before it was asked."""

    epoch: str
    resource: str
    hold: str
    grants: tuple[int, ...]
    """Of this container, shown by the call."""


class Byte(Record):
    """One byte on the wire, of the command of that time."""

    epoch: str
    resource: str
    hold: str
    command_t: float


class Grant(Record):
    """The table has granted."""

    epoch: str
    number: int
    resources: tuple[str, ...]
    lease_s: float


class Renewed(Record):
    """Leases began anew."""

    epoch: str
    numbers: tuple[int, ...]


class End(Record):
    """A grant holds no more; the time is that before it ended."""

    epoch: str
    number: int
    after_t: float


class Beat(Record):
    """The driver's process runs; what lies further apart than it should is time it did not have."""

    epoch: str


# --- what is done to them


class Fault(Record):
    """Something was done to a process."""

    what: str
    process: str


AnyRecord = Ask | Held | Seen | Done | Command | Byte | Grant | Renewed | End | Beat | Fault
_encode = msgspec.json.Encoder().encode


class Log:
    """A file of one process. A line is whole or not there, also after kill -9."""

    def __init__(self, folder: Path, process: str) -> None:
        path = folder / f"{process}-{os.getpid()}.jsonl"
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)

    def note(self, record: Record) -> None:
        os.write(self._fd, _encode(record) + b"\n")


def now() -> float:
    return time.monotonic()


def read(folder: Path) -> Iterator[AnyRecord]:
    """Every record of a run; the order is that of the files."""
    decode = msgspec.json.Decoder(AnyRecord).decode
    for path in sorted(folder.glob("*.jsonl")):
        yield from map(decode, path.read_bytes().splitlines())
