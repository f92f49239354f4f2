"""Reading a byte log: pure questions about what a bus has seen."""

from collections.abc import Iterable, Sequence
from math import inf
from pathlib import Path
from typing import Final

import msgspec

from trade_hil_sim.log._byte_log import Direction, Entry

__all__ = ["events", "frames", "instructions", "motion_writes", "read_log", "received", "sent", "writes"]

WRITING: Final = frozenset(
    {
        *("write", "write_one", "read_write", "reg_write", "action", "sync_write", "bulk_write"),
        *("sdo_write", "rpdo1", "rpdo2", "rpdo3", "rpdo4"),
        *("set_axis_state", "set_controller_mode", "set_input_pos", "set_input_vel", "set_input_torque"),
        *("enable", "disable", "write_register", "mit", "pos_vel", "vel", "force_pos"),
        *("move_j", "move_j_ik", "move_l", "move_l_fk", "servo_j", "servo_l", "speed_j", "upload"),
        *("teach_on", "freedrive_on"),
    }
)
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


def frames(
    entries: Iterable[Entry],
    name: str | None = None,
    *,
    can_id: int | None = None,
    device_id: int | None = None,
    source: str | None = None,
    direction: Direction | None = None,
    since: float = -inf,
    until: float = inf,
    bus: str | None = None,
) -> list[Entry]:
    """Frames that got through on CAN buses, in the order they did.

    Args:
        entries: where to look.
        name: ``sync``, ``rpdo1``, ``heartbeat``, ...; default: any.
        can_id: only this id.
        device_id: only those that come from this device or are addressed to it.
        source: only those sent by this joint or client.
        direction: ``in`` for those of clients, ``out`` for those of devices.
        since: earliest time in seconds on CLOCK_MONOTONIC.
        until: latest time in seconds on CLOCK_MONOTONIC.
        bus: only this bus.
    """
    wanted = {"name": name, "can_id": can_id, "device_id": device_id, "source": source, "direction": direction}
    asked = [(field, value) for field, value in wanted.items() if value is not None]
    return [
        e
        for e in entries
        if e.kind == "frame" and _within(e, since, until, bus) and all(getattr(e, f) == v for f, v in asked)
    ]


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
    """Every instruction that writes; arguments as `instructions`.

    On a Dynamixel bus: write, reg write, action, sync write, bulk write. On a CAN bus: SDO writes, and receive PDOs at
    the moment they take effect; one that only repeats what the device has is a frame, but no instruction.

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

    Of CAN drives: those that change controlword, mode or a target. Of arms: commands to move, set-points, freedrive.

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
