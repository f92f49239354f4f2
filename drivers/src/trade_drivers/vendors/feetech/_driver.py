"""Bringing a Feetech bus up."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, cast

from trade.errors import ConfigurationError
from trade_drivers.joints.serial import ServoAxis, ServoDriver, ServoExchange
from trade_drivers.robotfile import Joint, Robot, SerialBus
from trade_drivers.vendors.feetech import _table as table
from trade_drivers.vendors.feetech._axis import FeetechAxis
from trade_drivers.vendors.feetech._commission import FeetechCommissioner
from trade_drivers.vendors.feetech._cycle import FeetechExchange
from trade_drivers.vendors.feetech._inspect import check_bus, look_over

if TYPE_CHECKING:
    from trade_drivers.joints.serial._wire import ServoWire
    from trade_drivers.vendors.feetech._wire import Wire

__all__ = ["FeetechDriver", "open_exchange"]


class FeetechDriver(ServoDriver):
    """STS servos in position control on a serial bus."""

    name = "feetech"
    models = table.BY_MODEL_NAME
    bauds = table.BAUD_CODES
    modules = ("serial",)
    without_watchdog = "no watchdog: without its driver it goes on to the goal it has, which is never far ahead"
    commissioner = FeetechCommissioner

    def exchange(self, robot: Robot, bus: SerialBus, port: str, joints: list[Joint]) -> ServoExchange:
        axes = [
            FeetechAxis(f"{robot.name}.{joint.name}", port, joint, bus.watchdog_s, robot.coupled_to(joint.name))
            for joint in joints
        ]
        check_bus(robot, bus, axes)
        return FeetechExchange(wire_at(port, bus.baud, f"{robot.where}: bus.{bus.name}"), bus, axes)

    def look_over(
        self, wire: "ServoWire", bus: SerialBus, axis: ServoAxis[Any], clock_ns: Callable[[], int], where: str
    ) -> None:
        look_over(wire, bus, cast("FeetechAxis", axis), clock_ns, where)


def open_exchange(robot: Robot, bus: SerialBus, port: str) -> ServoExchange:
    """Open the port and look every joint over, without a thread: ``cycle()`` is the caller's to call.

    Raises:
        ConfigurationError: the port cannot be had, or a device is absent, another, or set wrongly.
    """
    return FeetechDriver().open_exchange(robot, bus, port)


def wire_at(port: str, baud: int, where: str) -> "Wire":
    """A line, not open yet. Raises ``ConfigurationError`` without pyserial."""
    try:
        from trade_drivers.vendors.feetech._wire import Wire  # noqa: PLC0415 - pyserial is optional
    except ImportError as missing:
        problem = f'needs pyserial ({missing}); pip install "trade-drivers[feetech]"'
        raise ConfigurationError(where="driver feetech", problem=problem) from None
    return Wire(port, baud, where)
