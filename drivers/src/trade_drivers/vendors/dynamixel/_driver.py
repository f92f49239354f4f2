"""Bringing a Dynamixel bus up."""

import logging
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final, cast

from trade.errors import ConfigurationError
from trade_drivers.joints.serial import ServoAxis, ServoDriver, ServoExchange
from trade_drivers.robotfile import Joint, Robot, SerialBus
from trade_drivers.vendors.dynamixel import _table as table
from trade_drivers.vendors.dynamixel._axis import DynamixelAxis
from trade_drivers.vendors.dynamixel._commission import DynamixelCommissioner
from trade_drivers.vendors.dynamixel._cycle import DynamixelExchange
from trade_drivers.vendors.dynamixel._inspect import check_bus, look_over

if TYPE_CHECKING:
    from trade_drivers.joints.serial._wire import ServoWire
    from trade_drivers.vendors.dynamixel._sdk import Wire

__all__ = ["DynamixelDriver", "open_exchange"]

_log = logging.getLogger("trade")
_SLOW_ANSWER_S: Final = 100e-6


class DynamixelDriver(ServoDriver):
    """X-series servos in position control on a serial bus, through dynamixel-sdk."""

    name = "dynamixel"
    models = table.BY_MODEL_NAME
    bauds = table.BAUD_CODES
    modules = ("dynamixel_sdk", "serial")
    commissioner = DynamixelCommissioner

    def exchange(self, robot: Robot, bus: SerialBus, port: str, joints: list[Joint]) -> ServoExchange:
        axes = [
            DynamixelAxis(f"{robot.name}.{joint.name}", port, joint, robot.coupled_to(joint.name)) for joint in joints
        ]
        check_bus(bus, axes, robot.where)
        wire = wire_at(port, bus.baud, f"{robot.where}: bus.{bus.name}", fast=bus.fast_sync)
        return DynamixelExchange(wire, bus, axes)

    def look_over(
        self, wire: "ServoWire", bus: SerialBus, axis: ServoAxis[Any], clock_ns: Callable[[], int], where: str
    ) -> None:
        delay_s = look_over(cast("Wire", wire), bus, cast("DynamixelAxis", axis), clock_ns, where)
        if delay_s > _SLOW_ANSWER_S:
            _log.info("%s waits %.0f us before it answers (register 9); 0 is faster", axis.name, delay_s * 1e6)


def open_exchange(robot: Robot, bus: SerialBus, port: str) -> ServoExchange:
    """Open the port and look every joint over, without a thread: ``cycle()`` is the caller's to call.

    Raises:
        ConfigurationError: the port cannot be had, or a device is absent, another, or set wrongly.
    """
    return DynamixelDriver().open_exchange(robot, bus, port)


def wire_at(port: str, baud: int, where: str, *, fast: bool = False) -> "Wire":
    """A line, not open yet. Raises ``ConfigurationError`` without the vendor library."""
    try:
        from trade_drivers.vendors.dynamixel._sdk import Wire  # noqa: PLC0415 - the vendor library is optional
    except ImportError as missing:
        problem = f'needs dynamixel-sdk ({missing}); pip install "trade-drivers[dynamixel]"'
        raise ConfigurationError(where="driver dynamixel", problem=problem) from None
    return Wire(port, baud, where, fast=fast)
