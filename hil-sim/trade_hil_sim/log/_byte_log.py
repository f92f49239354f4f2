"""The byte log: every chunk or frame on the wire, every decoded instruction and every device event, with its time.

Tests of safety rely on it: it has what a device received and did, not what a client believes it sent. Times are
``time.monotonic()`` (CLOCK_MONOTONIC), which on Linux is one clock for all processes of a machine.
"""

import os
from pathlib import Path
from typing import Literal

import msgspec

Kind = Literal["received", "sent", "frame", "instruction", "event"]
Direction = Literal["in", "out"]


class LogEntry(msgspec.Struct, frozen=True, omit_defaults=True):
    """One line of the log.

    - ``received`` and ``sent``: raw bytes, as the simulator read and wrote them. When a client has an answer, the
      log already has it and its cause.
    - ``frame``: one frame that got through on a CAN bus, at the end of its last bit, logged before it is delivered;
      ``name`` is what it is (``sync``, ``rpdo1``, ...), ``device_id`` the device it comes from or goes to.
    - ``instruction``: one decoded instruction, one entry for each device that a group write addresses.
    - ``event``: something that a device did by itself or in response: ``motion_started``, ``at_rest``, ``torque_on``,
      ``torque_off``, ``watchdog_expired``, ``watchdog_cleared``, ``rebooted``, ``refused``, ``shutdown``, ...
    """

    t: float
    """Seconds on CLOCK_MONOTONIC; of an event, when it happened in the device."""
    bus: str
    kind: Kind
    name: str = ""
    """The name of an instruction or event; for bytes sent, the instruction that they answer."""
    device_id: int | None = None
    """Id on the bus; 254 means all devices."""
    ids: tuple[int, ...] = ()
    """The ids in a group read."""
    joint: str = ""
    hex: str = ""
    """Bytes on the wire, or the data of an instruction."""
    can_id: int | None = None
    source: str = ""
    """The sender of a frame: a joint's name, or ``client1`` and so on in the order of connection."""
    direction: Direction | None = None
    """The direction of a frame: ``in`` from a client, ``out`` from a device."""
    address: int | None = None
    registers: tuple[str, ...] = ()
    """Names of the registers an instruction writes, looked up through indirect addresses."""
    moves: bool = False
    """Whether this instruction could start a motion: it writes torque or goal registers."""
    position_counts: int | None = None
    position_rad: float | None = None
    """The joint's angle in the robot file's sense; without a robot file, the device's angle from its centre."""
    width_m: float | None = None
    """Opening of a gripper."""
    detail: str = ""

    @property
    def data(self) -> bytes:
        """The bytes of this entry."""
        return bytes.fromhex(self.hex)


class ByteLog:
    """Collects entries in memory, in a file of JSON lines, or both.

    Every line goes to the kernel in one write: killing any process, this one included, loses nothing.

    Args:
        path: file to append to; created.
        keep: whether to keep entries in memory as well; default: only when there is no file.
    """

    def __init__(self, path: Path | None = None, *, keep: bool | None = None) -> None:
        self.path = path
        self._entries: list[LogEntry] = []
        self._keep = path is None if keep is None else keep
        self._encoder = msgspec.json.Encoder()
        flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC
        self._fd = None if path is None else os.open(path, flags, 0o644)

    def add(self, entry: LogEntry) -> None:
        """Record one entry; any thread may call this."""
        if self._keep:
            self._entries.append(entry)
        if self._fd is not None:
            os.write(self._fd, self._encoder.encode(entry) + b"\n")

    @property
    def entries(self) -> list[LogEntry]:
        """A copy of what is kept in memory."""
        return list(self._entries)

    def close(self) -> None:
        """Close the file; entries in memory stay readable."""
        fd, self._fd = self._fd, None
        if fd is not None:
            os.close(fd)

    def __enter__(self) -> "ByteLog":
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()
