"""Scanning an open CAN bus for ODrives: requests only the version, and only from ODrives heard on it."""

import struct
import time
from typing import Final

from trade_drivers.commissioning._can_scan import CanBench
from trade_drivers.commissioning._commissioner import Found
from trade_drivers.vendors.odrive._axis import MODELS
from trade_drivers.vendors.odrive._frames import NODES, Command, Heartbeat, State, Version, frame_id, orders

_ANSWER_S: Final = 0.25
_ATTEMPTS: Final = 3


class OdriveBench(CanBench):
    """One CAN bus."""

    driver = "odrive"
    remedy = "odrivetool or its web interface"
    zero = "its zero is set by odrivetool or its web interface"

    orders = staticmethod(orders)

    def refuse(self) -> None:
        """Sends no requests to other nodes."""

    def anybody(self) -> bool:
        return bool(self._talk.odrives) or self._nameless() is not None

    def look(self, device_id: int) -> Found | None:
        if device_id == NODES:
            return self._nameless()
        beat = self._talk.odrives.get(device_id)
        if beat is None:
            return None
        torque = Heartbeat.decode(beat).state != State.IDLE
        version = self._version(device_id)
        if version is None:
            problem = "its heartbeat is heard, but it does not tell its version: its firmware is older than 0.6"
            return self.found(device_id, torque=torque, problem=problem)
        names = [name for name, model in MODELS.items() if model.line == version.line]
        return self.found(
            device_id,
            names[0] if names else f"product line {version.line}",
            firmware=".".join(map(str, version.firmware)),
            torque=torque,
            problem="" if names else f"this driver knows {', '.join(MODELS)}",
        )

    def _nameless(self) -> Found | None:
        """Returns an ODrive that reported its serial number instead of a node."""
        for data in self._talk.frames.get(frame_id(NODES, Command.ADDRESS), ()):
            if len(data) == struct.calcsize("<B6s"):
                serial_number = int.from_bytes(data[1:], "little")
                problem = f"it has no node number yet; give it one by {self.remedy}"
                return self.found(NODES, serial_number=serial_number, problem=problem)
        return None

    def _version(self, node: int) -> Version | None:
        wanted = frame_id(node, Command.VERSION)
        for _ in range(_ATTEMPTS):
            self._port.send(wanted, b"")
            until = time.monotonic() + _ANSWER_S
            while (left_s := until - time.monotonic()) > 0:
                frame = self._port.receive(left_s)
                if frame is not None and frame.id == wanted and frame.data:
                    return Version.decode(frame.data)
        return None
