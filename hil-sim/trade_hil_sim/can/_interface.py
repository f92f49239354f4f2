"""A SocketCAN interface as adapter: programs that open a virtual interface of the system join the simulated bus."""

import socket
import struct
import time
from collections.abc import Callable
from contextlib import suppress
from errno import ENETDOWN
from pathlib import Path
from typing import Final

from trade_hil_sim.faults._commands import SimulationError
from trade_hil_sim.robot._bus_thread import ready

from ._adapter import AdapterObserver
from ._frame import Frame

LAYOUT: Final = struct.Struct("=IB3x8s")
"""``struct can_frame`` of linux/can.h."""
EXTENDED: Final = 0x8000_0000
REMOTE: Final = 0x4000_0000
ERROR: Final = 0x2000_0000
STANDARD_MASK: Final = 0x7FF
EXTENDED_MASK: Final = 0x1FFF_FFFF


class Interface:
    """All programs that have opened one interface, as one client: the system does not distinguish them.

    The interface must be a ``vcan``: simulated drives must not reach a real wire.

    Args:
        channel: the interface's name.
        observer: receives what is sent on it.
    """

    def __init__(self, channel: str, observer: AdapterObserver) -> None:
        self.channel = self.name = channel
        self.overrun = 0
        self._observer = observer
        self._socket: socket.socket | None = None

    @property
    def port(self) -> str:
        """What a client opens: ``socketcan:vcan0``."""
        return f"socketcan:{self.channel}"

    @property
    def plugged(self) -> bool:
        """Whether devices and interface are connected."""
        return self._socket is not None

    def open(self) -> None:
        """Join the interface; raises SimulationError if it does not exist or is not virtual."""
        where = Path("/sys/class/net") / self.channel
        if not where.exists():
            raise SimulationError(f"there is no interface {self.channel}; `ip link add {self.channel} type vcan`")
        if "virtual" not in where.resolve().parts:
            raise SimulationError(f"{self.channel} is a real bus; simulated devices only go on virtual ones (vcan)")
        self.plug_in()

    def plug_in(self) -> None:
        """Join it again; raises SimulationError if it is gone."""
        if self._socket is None:
            self._socket = _joined(self.channel)
            self._observer.joined(self)

    def unplug(self) -> None:
        """Disconnect the devices; programs that have the interface open receive nothing more."""
        gone, self._socket = self._socket, None
        if gone is not None:
            gone.close()
            self._observer.left(self)

    def close(self) -> None:
        """Disconnect the devices."""
        self.unplug()

    def serve(self, wake_read: int, wait_s: float, awake: Callable[[float], None]) -> bool:
        """Wait for frames, a wake-up or the end of the wait, then pass the frames on; see `Adapter`."""
        opened = self._socket
        watched: list[int | socket.socket] = [wake_read] if opened is None else [wake_read, opened]
        readable = ready(watched, (), max(0.0, wait_s))
        t = time.monotonic()
        awake(t)
        if opened is not None and opened in readable:
            self._read(opened, t)
        return wake_read in readable

    def _read(self, opened: socket.socket, t: float) -> None:
        while opened is self._socket:
            try:
                data = opened.recv(LAYOUT.size)
            except BlockingIOError:
                return
            except OSError as bad:
                if bad.errno != ENETDOWN:  # an interface that is down may come up again; any other error: it is gone
                    self.unplug()
                return
            head, length, payload = LAYOUT.unpack(data)
            if not head & ERROR:
                self._observer.submitted(self, _frame(head, length, payload), t)

    def queue_frame(self, frame: Frame, wall_s: float) -> bool:  # noqa: ARG002 - the system notes the time
        """Put a frame on it; False if it is lost."""
        head = frame.can_id | (EXTENDED if frame.extended else 0) | (REMOTE if frame.remote else 0)
        return self._send(head, frame.length if frame.remote else len(frame.data), frame.data)

    def queue_error(self, bits: int, wall_s: float) -> bool:  # noqa: ARG002
        """Put an error frame on it."""
        return self._send(ERROR | bits, 8, b"")

    def _send(self, head: int, length: int, data: bytes) -> bool:
        sent = 0
        if self._socket is not None:
            with suppress(OSError):  # it is down, or full
                sent = self._socket.send(LAYOUT.pack(head, length, data))
        self.overrun = 0 if sent else self.overrun + 1
        return bool(sent)

    def flush(self) -> None:
        """Do nothing: frames are sent at once, not queued."""


def _joined(channel: str) -> socket.socket:
    try:
        made = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    except OSError as bad:
        raise SimulationError(f"{channel}: this system has no SocketCAN ({bad})") from None
    try:
        made.bind((channel,))
        made.setblocking(False)
    except OSError as bad:
        made.close()
        raise SimulationError(f"{channel}: {bad}") from None
    return made


def _frame(head: int, length: int, payload: bytes) -> Frame:
    extended, remote = bool(head & EXTENDED), bool(head & REMOTE)
    can_id = head & (EXTENDED_MASK if extended else STANDARD_MASK)
    return Frame(can_id, b"" if remote else payload[:length], extended, remote, length if remote else 0)
