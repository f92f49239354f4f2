"""The driver of a bus of ODrives, and its scan, which requests only the version, from ODrives heard on the bus."""

import struct
from typing import TYPE_CHECKING, Final

from trade_drivers.commissioning._can_scan import CanBench
from trade_drivers.commissioning._commissioner import ScannedDevice
from trade_drivers.joints.can import CanMotorCommissioner, CanMotorDriver
from trade_drivers.vendors.odrive._axis import OdriveAxis
from trade_drivers.vendors.odrive._frames import Heartbeat, Version, frame_id
from trade_drivers.vendors.odrive._table import MODELS, NODES, Command, State, orders

if TYPE_CHECKING:
    from trade_drivers.vendors.odrive._exchange import OdriveExchange

_ANSWER_S: Final = 0.25


class OdriveBench(CanBench):
    """One CAN bus with ODrives."""

    driver = "odrive"
    remedy = "odrivetool or its web interface"
    zero = "its zero is set by odrivetool or its web interface"

    orders = staticmethod(orders)

    def refuse(self) -> None:
        """Sends no requests to other nodes."""

    def anybody(self) -> bool:
        return bool(self._sniffed.odrives) or self._nameless() is not None

    def look(self, device_id: int) -> ScannedDevice | None:
        if device_id == NODES:
            return self._nameless()
        beat = self._sniffed.odrives.get(device_id)
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

    def _nameless(self) -> ScannedDevice | None:
        """Returns an ODrive that reported its serial number instead of a node."""
        for data in self._sniffed.frames.get(frame_id(NODES, Command.ADDRESS), ()):
            if len(data) == struct.calcsize("<B6s"):
                serial_number = int.from_bytes(data[1:], "little")
                problem = f"it has no node number yet; give it one by {self.remedy}"
                return self.found(NODES, serial_number=serial_number, problem=problem)
        return None

    def _version(self, node: int) -> Version | None:
        wanted = frame_id(node, Command.VERSION)
        data = self.ask(wanted, b"", lambda frame: (frame.data or None) if frame.id == wanted else None, _ANSWER_S)
        return Version.decode(data[0]) if data else None


class OdriveCommissioner(CanMotorCommissioner):
    """ODrives; one without a node number is shown with the number 63."""

    driver = "odrive"
    ids = range(NODES + 1)

    def bench(self) -> type[OdriveBench]:
        return OdriveBench


class OdriveDriver(CanMotorDriver[OdriveAxis, "OdriveExchange"]):
    """ODrives with firmware 0.6 on a CAN bus.

    In a robot file::

        [bus.arm]
        driver = "odrive"
        interface = "socketcan"
        channel = "can0"
        leave = "relax"

        [joint.elbow]
        bus = "arm"
        id = 3
        model = "ODrive S1"
        gear = 8
        zero = "last"
        min_rad = -1.4
        max_rad = 1.4
        max_speed_rad_s = 2.0
        max_accel_rad_s2 = 10.0
    """

    name = "odrive"
    models = MODELS
    commissioner = OdriveCommissioner
    orders = staticmethod(orders)

    def exchange_type(self) -> "type[OdriveExchange]":
        from trade_drivers.vendors.odrive._exchange import OdriveExchange  # noqa: PLC0415 - python-can is optional

        return OdriveExchange
