"""The driver of a Dynamixel bus."""

import logging
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from trade_drivers._validation import not_installed
from trade_drivers.joints.serial import ServoDriver
from trade_drivers.vendors.dynamixel import _table as table
from trade_drivers.vendors.dynamixel._axis import DynamixelAxis
from trade_drivers.vendors.dynamixel._commission import DynamixelCommissioner
from trade_drivers.vendors.dynamixel._cycle import DynamixelExchange
from trade_drivers.vendors.dynamixel._inspect import check_bus, look_over
from trade_robotfile import Joint, Robot, SerialBus

if TYPE_CHECKING:
    from trade_drivers.vendors.dynamixel._wire import Wire

_log = logging.getLogger("trade")
_SLOW_ANSWER_S: Final = 100e-6


class DynamixelDriver(ServoDriver[DynamixelAxis, "Wire"]):
    """X-series servos in position control on a serial bus, through dynamixel-sdk.

    In a robot file::

        [bus.arm]
        driver = "dynamixel"
        port = "/dev/serial/by-id/usb-1a86_USB_Single_Serial_58FA083324-if00"
        baud = 1_000_000

        [joint.elbow]
        bus = "arm"
        id = 3
        model = "XL430-W250"
        min_rad = -1.4
        max_rad = 1.4
        max_speed_rad_s = 2.5
        max_accel_rad_s2 = 20.0
    """

    name = "dynamixel"
    models = table.BY_MODEL_NAME
    bauds = table.BAUD_CODES
    modules = ("dynamixel_sdk", "serial")
    commissioner = DynamixelCommissioner

    def exchange(self, robot: Robot, bus: SerialBus, port: str, joints: list[Joint]) -> DynamixelExchange:
        axes = [
            DynamixelAxis(f"{robot.name}.{joint.name}", port, joint, robot.coupled_to(joint.name)) for joint in joints
        ]
        check_bus(bus, axes, robot.where)
        wire = wire_at(port, bus.baud, f"{robot.where}: bus.{bus.name}", fast=bus.fast_sync)
        return DynamixelExchange(wire, bus, axes)

    def look_over(
        self, wire: "Wire", bus: SerialBus, axis: DynamixelAxis, clock_ns: Callable[[], int], where: str
    ) -> None:
        delay_s = look_over(wire, bus, axis, clock_ns, where)
        if delay_s > _SLOW_ANSWER_S:
            _log.info("%s waits %.0f us before it answers (register 9); 0 is faster", axis.name, delay_s * 1e6)


def wire_at(port: str, baud: int, where: str, *, fast: bool = False) -> "Wire":
    """Returns a closed line. Raises ``ConfigurationError`` without the vendor library."""
    try:
        from trade_drivers.vendors.dynamixel._wire import Wire  # noqa: PLC0415 - the vendor library is optional
    except ImportError as missing:
        raise not_installed("dynamixel", "dynamixel-sdk", missing) from None
    return Wire(port, baud, where, fast=fast)
