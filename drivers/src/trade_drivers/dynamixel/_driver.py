"""Bringing a Dynamixel bus up, and handing out its motors."""

import logging
from collections.abc import Callable
from contextlib import ExitStack
from typing import TYPE_CHECKING, Final

from trade.errors import ConfigurationError
from trade_drivers._driver import AttachedBus, Driver
from trade_drivers.dynamixel import _table as table
from trade_drivers.dynamixel._attach import check_bus, look_over
from trade_drivers.dynamixel._axis import ServoAxis
from trade_drivers.dynamixel._exchange import ServoExchange
from trade_drivers.dynamixel._wire import WireError
from trade_drivers.joints import AttachedJoints, BusThread, PortLost
from trade_drivers.robotfile import Bus, Joint, Robot, SerialBus

if TYPE_CHECKING:
    from trade_drivers.dynamixel._sdk import Wire

__all__ = ["DynamixelDriver", "open_exchange"]

_log = logging.getLogger("trade")
_SLOW_ANSWER_S: Final = 100e-6


class DynamixelDriver(Driver):
    """X-series servos in position control on a serial bus, through dynamixel-sdk."""

    def attach(self, robot: Robot, bus: Bus, port: str, healthy: Callable[[], bool]) -> AttachedBus:
        if not isinstance(bus, SerialBus):
            problem = "driver dynamixel needs a serial bus: port instead of interface and channel"
            raise ConfigurationError(where=f"{robot.where}: bus.{bus.name}", problem=problem)
        with ExitStack() as undo:
            exchange = open_exchange(robot, bus, port)
            undo.callback(exchange.wire.close)
            thread = BusThread(exchange, exchange.wire, bus, healthy, name=f"bus {robot.name}.{bus.name}")
            thread.start()
            undo.pop_all()
        return AttachedJoints(thread)


def open_exchange(robot: Robot, bus: SerialBus, port: str) -> ServoExchange:
    """Open the port and look every joint over, without a thread: ``cycle()`` is the caller's to call.

    Raises:
        ConfigurationError: the port cannot be had, or a device is absent, another, or set wrongly.
    """
    axes = [
        ServoAxis(f"{robot.name}.{joint.name}", port, joint, robot.coupled_to(joint.name))
        for joint in _known(robot, bus)
    ]
    check_bus(bus, axes, robot.where)
    table_of_bus = f"{robot.where}: bus.{bus.name}"
    wire = _wire(port, bus.baud, table_of_bus)
    where = f"{table_of_bus}.port"
    try:
        wire.open()
        exchange = ServoExchange(wire, bus, axes)
        for axis in axes:
            delay_s = look_over(wire, bus, axis, exchange.clock, robot.where)
            if delay_s > _SLOW_ANSWER_S:
                _log.info("%s waits %.0f us before it answers (register 9); 0 is faster", axis.name, delay_s * 1e6)
        for axis in axes:
            exchange.admit(axis)
        exchange.cycle()
    except PortLost as lost:
        wire.close()
        problem = f"{port}: {lost}; `ls -l /dev/serial/by-id` shows those that are"
        raise ConfigurationError(where=where, problem=problem) from None
    except WireError as bad:
        wire.close()
        raise ConfigurationError(
            where=where, problem=f"the bus does not work reliably: {bad}; check cable and power"
        ) from bad
    except BaseException:
        wire.close()
        raise
    return exchange


def _known(robot: Robot, bus: SerialBus) -> list[Joint]:
    joints = robot.joints_on(bus.name)
    for joint in joints:
        if joint.model not in table.BY_MODEL_NAME:
            problem = f"{joint.model!r} is unknown to the driver dynamixel; it knows {', '.join(table.BY_MODEL_NAME)}"
            raise ConfigurationError(where=f'{robot.where}: joint."{joint.name}".model', problem=problem)
        if joint.counts_per_rev is not None or joint.gear != 1:
            problem = "counts_per_rev and gear are for other devices: a servo's angle is that of its joint"
            raise ConfigurationError(where=f'{robot.where}: joint."{joint.name}"', problem=problem)
    return joints


def _wire(port: str, baud: int, where: str) -> "Wire":
    try:
        from trade_drivers.dynamixel._sdk import Wire  # noqa: PLC0415 - the vendor library is optional
    except ImportError as missing:
        problem = f'needs dynamixel-sdk ({missing}); pip install "trade-drivers[dynamixel]"'
        raise ConfigurationError(where="driver dynamixel", problem=problem) from None
    return Wire(port, baud, where)
