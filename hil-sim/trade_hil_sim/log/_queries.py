"""Reads a byte log: pure queries about what a bus has seen."""

from collections.abc import Iterable, Iterator, Sequence
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypedDict

import msgspec

from trade_hil_sim.log._byte_log import Direction, Kind, LogEntry

if TYPE_CHECKING:
    from typing_extensions import Unpack

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
BROADCAST: Final = 254


class Span(TypedDict, total=False):
    """Which part of a log to look at."""

    since: float
    """Earliest time in seconds on CLOCK_MONOTONIC."""
    until: float
    """Latest time in seconds on CLOCK_MONOTONIC."""
    bus: str | None
    """Only this bus."""


def read_log(path: Path | str) -> list[LogEntry]:
    """All entries of a log file so far, in the order they were written.

    A last line that is still being written is left out, so a running simulator's log can be read.
    """
    whole, _, _ = Path(path).read_bytes().rpartition(b"\n")
    return msgspec.json.Decoder(LogEntry).decode_lines(whole) if whole else []


def received(entries: Iterable[LogEntry], **span: "Unpack[Span]") -> bytes:
    """The bytes that came in, joined."""
    return b"".join(e.data for e in _of_kind("received", entries, **span))


def sent(entries: Iterable[LogEntry], **span: "Unpack[Span]") -> bytes:
    """The bytes that went out, joined."""
    return b"".join(e.data for e in _of_kind("sent", entries, **span))


def frames(
    entries: Iterable[LogEntry],
    name: str | None = None,
    *,
    can_id: int | None = None,
    device_id: int | None = None,
    source: str | None = None,
    direction: Direction | None = None,
    **span: "Unpack[Span]",
) -> list[LogEntry]:
    """Frames that got through on CAN buses, in that order.

    Args:
        entries: where to look.
        name: ``sync``, ``rpdo1``, ``heartbeat``, ...; default: any.
        can_id: only this id.
        device_id: only those that come from this device or are addressed to it.
        source: only those sent by this joint or client.
        direction: ``in`` for those of clients, ``out`` for those of devices.
        **span: `Span`.
    """
    wanted = {"name": name, "can_id": can_id, "device_id": device_id, "source": source, "direction": direction}
    asked = [(field, value) for field, value in wanted.items() if value is not None]
    return [e for e in _of_kind("frame", entries, **span) if all(getattr(e, f) == v for f, v in asked)]


def instructions(
    entries: Iterable[LogEntry], name: str | None = None, *, device_id: int | None = None, **span: "Unpack[Span]"
) -> list[LogEntry]:
    """Decoded instructions; broadcasts (id 254) count for every device.

    Args:
        entries: where to look.
        name: ``ping``, ``read``, ``write``, ``sync_read``, ...; default: any.
        device_id: only those a device of this id obeys.
        **span: `Span`.
    """
    found = _of_kind("instruction", entries, **span)
    return [e for e in found if name in {None, e.name} and _concerns(e, device_id)]


def writes(
    entries: Iterable[LogEntry], *, device_id: int | None = None, register: str | None = None, **span: "Unpack[Span]"
) -> list[LogEntry]:
    """Every instruction that writes; arguments as `instructions`, and `register`: only those that touch it.

    On a Dynamixel bus: write, reg write, action, sync write, bulk write. On a CAN bus: SDO writes, and receive PDOs at
    the moment they take effect; one that only repeats what the device has is a frame, but no instruction.
    """
    found = instructions(entries, device_id=device_id, **span)
    return [e for e in found if e.name in WRITING and (register is None or register in e.registers)]


def motion_writes(
    entries: Iterable[LogEntry], *, device_id: int | None = None, **span: "Unpack[Span]"
) -> list[LogEntry]:
    """The writes that could move something: those that touch torque or goal registers; arguments as `writes`.

    Of CAN drives: those that change controlword, mode or a target. Of arms: commands to move, set-points, freedrive.

    A registered write counts, and so does the action that triggers it. Switching torque off counts, too.
    """
    return [e for e in writes(entries, device_id=device_id, **span) if e.moves]


def events(
    entries: Iterable[LogEntry], name: str | None = None, *, device_id: int | None = None, **span: "Unpack[Span]"
) -> list[LogEntry]:
    """What devices did: ``motion_started``, ``at_rest``, ``watchdog_expired``, ...; arguments as `instructions`."""
    found = _of_kind("event", entries, **span)
    return [e for e in found if name in {None, e.name} and device_id in {None, e.device_id}]


def _of_kind(
    kind: Kind, entries: Iterable[LogEntry], *, since: float = -inf, until: float = inf, bus: str | None = None
) -> Iterator[LogEntry]:
    return (e for e in entries if e.kind == kind and since <= e.t <= until and bus in {None, e.bus})


def _concerns(entry: LogEntry, device_id: int | None) -> bool:
    named: Sequence[int | None] = entry.ids or (entry.device_id,)
    return device_id is None or device_id in named or (entry.device_id == BROADCAST and not entry.ids)
