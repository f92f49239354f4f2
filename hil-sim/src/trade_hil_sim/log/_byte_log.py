"""The byte log: every chunk or frame on the wire, every decoded instruction and every device event, with its time.

It is the judge in tests of safety: what a device received and did, not what anybody believes to have sent. Times are
``time.monotonic()`` (CLOCK_MONOTONIC), which on Linux is one clock for all processes of a machine.
"""

import os
from pathlib import Path
from typing import Literal

import msgspec

__all__ = ["ByteLog", "Direction", "Entry", "Kind"]

Kind = Literal["received", "sent", "frame", "instruction", "event"]
Direction = Literal["in", "out"]


class Entry(msgspec.Struct, frozen=True, omit_defaults=True):
    """One line of the log.

    - ``received`` and ``sent``: raw bytes, as the simulator read and wrote them. A client that has an answer finds it,
      and what led to it, in the log.
    - ``frame``: one frame that got through on a CAN bus, at the end of its last bit, logged before anybody hears it;
      ``name`` is what it is (``sync``, ``rpdo1``, ...), ``device_id`` the device it comes from or goes to.
    - ``instruction``: one decoded instruction, one entry for each device that a group write addresses.
    - ``event``: something a device did by itself or in answer: ``motion_started``, ``at_rest``, ``torque_on``,
      ``torque_off``, ``watchdog_expired``, ``watchdog_cleared``, ``rebooted``, ``refused``, ``shutdown``, ...
    """

    t: float
    """Seconds on CLOCK_MONOTONIC; of an event, when it happened in the device."""
    bus: str
    kind: Kind
    name: str = ""
    """Of an instruction or event: which; of bytes sent: the instruction they answer."""
    device_id: int | None = None
    """Id on the bus; 254 stands for all devices."""
    ids: tuple[int, ...] = ()
    """Of a group read: the ids it names."""
    joint: str = ""
    hex: str = ""
    """The bytes: on the wire, or the data an instruction carries."""
    can_id: int | None = None
    source: str = ""
    """Of a frame: who sent it, a joint's name or ``client1`` and so on in the order they came."""
    direction: Direction | None = None
    """Of a frame: ``in`` from a client, ``out`` from a device."""
    address: int | None = None
    registers: tuple[str, ...] = ()
    """Names of the registers an instruction writes, looked up through indirect addresses."""
    moves: bool = False
    """Whether this instruction could set something moving: it writes torque or goal registers."""
    position_counts: int | None = None
    position_rad: float | None = None
    """The joint's angle in the robot file's sense; without a robot file, the device's angle from its centre."""
    width_m: float | None = None
    """How far a gripper is open."""
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
        self._entries: list[Entry] = []
        self._keep = path is None if keep is None else keep
        self._encoder = msgspec.json.Encoder()
        flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC
        self._fd = None if path is None else os.open(path, flags, 0o644)

    def add(self, entry: Entry) -> None:
        """Record one entry; any thread may call this."""
        if self._keep:
            self._entries.append(entry)
        if self._fd is not None:
            os.write(self._fd, self._encoder.encode(entry) + b"\n")

    @property
    def entries(self) -> list[Entry]:
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
