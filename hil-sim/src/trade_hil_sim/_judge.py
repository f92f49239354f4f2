"""Reading a byte log: pure questions about what a bus has seen."""

from collections.abc import Iterable, Sequence
from math import inf
from pathlib import Path
from typing import Final

import msgspec

from ._log import Entry

__all__ = ["events", "instructions", "motion_writes", "read_log", "received", "sent", "writes"]

WRITING: Final = frozenset({"write", "write_one", "read_write", "reg_write", "action", "sync_write", "bulk_write"})
EVERYBODY: Final = 254


def read_log(path: Path | str) -> list[Entry]:
    """All entries of a log file so far, in the order they were written.

    A last line that is still being written is left out, so a running simulator's log can be read.
    """
    whole, _, _ = Path(path).read_bytes().rpartition(b"\n")
    return msgspec.json.Decoder(Entry).decode_lines(whole) if whole else []


def received(entries: Iterable[Entry], *, since: float = -inf, until: float = inf, bus: str | None = None) -> bytes:
    """The bytes that came in, joined."""
    return b"".join(e.data for e in entries if e.kind == "received" and _within(e, since, until, bus))


def sent(entries: Iterable[Entry], *, since: float = -inf, until: float = inf, bus: str | None = None) -> bytes:
    """The bytes that went out, joined."""
    return b"".join(e.data for e in entries if e.kind == "sent" and _within(e, since, until, bus))


def instructions(
    entries: Iterable[Entry],
    name: str | None = None,
    *,
    device_id: int | None = None,
    since: float = -inf,
    until: float = inf,
    bus: str | None = None,
) -> list[Entry]:
    """Decoded instructions; those to everybody (id 254) count for every device.

    Args:
        entries: where to look.
        name: ``ping``, ``read``, ``write``, ``sync_read``, ...; default: any.
        device_id: only those a device of this id obeys.
        since: earliest time in seconds on CLOCK_MONOTONIC.
        until: latest time in seconds on CLOCK_MONOTONIC.
        bus: only this bus.
    """
    return [
        e
        for e in entries
        if e.kind == "instruction"
        and _within(e, since, until, bus)
        and name in {None, e.name}
        and _concerns(e, device_id)
    ]


def writes(
    entries: Iterable[Entry],
    *,
    device_id: int | None = None,
    register: str | None = None,
    since: float = -inf,
    until: float = inf,
    bus: str | None = None,
) -> list[Entry]:
    """Every instruction that writes: write, reg write, action, sync write, bulk write; arguments as `instructions`.

    Args:
        entries: where to look.
        device_id: only those a device of this id obeys.
        register: only those that touch the register of this name, such as ``goal_position``.
        since: earliest time in seconds on CLOCK_MONOTONIC.
        until: latest time in seconds on CLOCK_MONOTONIC.
        bus: only this bus.
    """
    found = instructions(entries, device_id=device_id, since=since, until=until, bus=bus)
    return [e for e in found if e.name in WRITING and (register is None or register in e.registers)]


def motion_writes(
    entries: Iterable[Entry],
    *,
    device_id: int | None = None,
    since: float = -inf,
    until: float = inf,
    bus: str | None = None,
) -> list[Entry]:
    """The writes that could move something: those that touch torque or goal registers; arguments as `writes`.

    A registered write counts, and so does the action that lets it loose. Switching torque off counts, too.
    """
    return [e for e in writes(entries, device_id=device_id, since=since, until=until, bus=bus) if e.moves]


def events(
    entries: Iterable[Entry],
    name: str | None = None,
    *,
    device_id: int | None = None,
    since: float = -inf,
    until: float = inf,
    bus: str | None = None,
) -> list[Entry]:
    """What devices did: ``motion_started``, ``at_rest``, ``watchdog_expired``, ...; arguments as `instructions`."""
    return [
        e
        for e in entries
        if e.kind == "event"
        and _within(e, since, until, bus)
        and name in {None, e.name}
        and device_id in {None, e.device_id}
    ]


def _within(entry: Entry, since: float, until: float, bus: str | None) -> bool:
    return since <= entry.t <= until and bus in {None, entry.bus}


def _concerns(entry: Entry, device_id: int | None) -> bool:
    named: Sequence[int | None] = entry.ids or (entry.device_id,)
    return device_id is None or device_id in named or (entry.device_id == EVERYBODY and not entry.ids)
