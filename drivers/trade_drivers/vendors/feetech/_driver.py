"""The driver of a Feetech bus."""

from collections.abc import Callable
from typing import TYPE_CHECKING

from trade_drivers._validation import not_installed
from trade_drivers.joints.serial import ServoDriver
from trade_drivers.vendors.feetech import _table as table
from trade_drivers.vendors.feetech._axis import FeetechAxis
from trade_drivers.vendors.feetech._commission import FeetechCommissioner
from trade_drivers.vendors.feetech._cycle import FeetechExchange
from trade_drivers.vendors.feetech._inspect import check_bus, look_over
from trade_robotfile import Joint, Robot, SerialBus

if TYPE_CHECKING:
    from trade_drivers.vendors.feetech._wire import Wire


class FeetechDriver(ServoDriver[FeetechAxis, "Wire"]):
    """STS servos in position control on a serial bus.

    In a robot file::

        [bus.arm]
        driver = "feetech"
        port = "/dev/serial/by-id/usb-1a86_USB_Single_Serial_58FA083324-if00"
        baud = 1_000_000

        [joint.elbow]
        bus = "arm"
        id = 3
        model = "STS3215"
        min_rad = -1.4
        max_rad = 1.4
        max_speed_rad_s = 2.5
        max_accel_rad_s2 = 20.0
    """

    name = "feetech"
    models = table.BY_MODEL_NAME
    bauds = table.BAUD_CODES
    modules = ("serial",)
    without_watchdog = "no watchdog: without its driver it continues to its last goal, which is never far ahead"
    commissioner = FeetechCommissioner

    def exchange(self, robot: Robot, bus: SerialBus, port: str, joints: list[Joint]) -> FeetechExchange:
        axes = [
            FeetechAxis(f"{robot.name}.{joint.name}", port, joint, bus.watchdog_s, robot.coupled_to(joint.name))
            for joint in joints
        ]
        check_bus(robot, bus, axes)
        return FeetechExchange(wire_at(port, bus.baud, f"{robot.where}: bus.{bus.name}"), bus, axes)

    def look_over(
        self, wire: "Wire", bus: SerialBus, axis: FeetechAxis, clock_ns: Callable[[], int], where: str
    ) -> None:
        look_over(wire, bus, axis, clock_ns, where)


def wire_at(port: str, baud: int, where: str) -> "Wire":
    """A line, not open yet. Raises ``ConfigurationError`` without pyserial."""
    try:
        from trade_drivers.vendors.feetech._wire import Wire  # noqa: PLC0415 - pyserial is optional
    except ImportError as missing:
        raise not_installed("feetech", "pyserial", missing) from None
    return Wire(port, baud, where)
