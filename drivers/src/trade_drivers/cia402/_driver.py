"""Bringing a bus of CiA 402 drives up, and handing out its motors."""

import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import TYPE_CHECKING, Final

from trade.errors import ConfigurationError
from trade_drivers._driver import AttachedBus, Driver
from trade_drivers.joints import BusThread, PortLost
from trade_drivers.robotfile import Bus, CanBus, Robot

if TYPE_CHECKING:
    from trade_drivers.can import CanPort
    from trade_drivers.cia402._axis import DriveAxis
    from trade_drivers.cia402._exchange import DriveExchange

__all__ = ["Cia402Driver", "open_exchange"]

_PATIENCE_S: Final = 1.0
"""A drive that has just been switched on needs a moment before it answers."""
_FIRST_CYCLES: Final = 3
"""As many measurements as it takes to see whether a joint moves."""


class Cia402Driver(Driver):
    """Drives in profile position mode on a CAN bus, through python-can and canopen."""

    def attach(self, robot: Robot, bus: Bus, port: str, healthy: Callable[[], bool]) -> AttachedBus:
        if not isinstance(bus, CanBus):
            problem = "driver cia402 needs a CAN bus: interface and channel instead of port"
            raise ConfigurationError(where=f"{robot.where}: bus.{bus.name}", problem=problem)
        with ExitStack() as undo:
            exchange = open_exchange(robot, bus, port)
            undo.callback(exchange.port.close)
            thread = BusThread(exchange, exchange.port, bus, healthy, name=f"bus {robot.name}.{bus.name}")
            thread.start()
            undo.pop_all()
        from trade_drivers.cia402._motor import AttachedDrives  # noqa: PLC0415 - the libraries are optional

        return AttachedDrives(thread, exchange.port)


def open_exchange(robot: Robot, bus: CanBus, port: str) -> "DriveExchange":
    """Open the port and look every drive over, without a thread: ``cycle()`` is the caller's to call.

    Raises:
        ConfigurationError: the port cannot be had, or a drive is absent, another, or cannot be used as it is.
    """
    try:
        from trade_drivers.can import CanPort  # noqa: PLC0415 - the libraries are optional
        from trade_drivers.cia402._attach import check_bus  # noqa: PLC0415
        from trade_drivers.cia402._axis import DriveAxis  # noqa: PLC0415
        from trade_drivers.cia402._exchange import DriveExchange  # noqa: PLC0415
    except ImportError as missing:
        problem = f'needs canopen and python-can ({missing}); pip install "trade-drivers[cia402]"'
        raise ConfigurationError(where="driver cia402", problem=problem) from None
    axes = [
        DriveAxis(f"{robot.name}.{joint.name}", port, joint, bus.rate_hz, robot.coupled_to(joint.name))
        for joint in robot.joints_on(bus.name)
    ]
    check_bus(bus, axes, robot.where)
    where = f"{robot.where}: bus.{bus.name}"
    wire = CanPort(port, bus.bitrate, where)
    with ExitStack() as undo:
        undo.callback(wire.close)
        try:
            wire.open()
            exchange = DriveExchange(wire, bus, axes)
            exchange.net.take_in(bus.watchdog_s)
            if exchange.rival:
                problem = f"{port}: another driver commands the drives of this bus already; stop it first"
                raise ConfigurationError(where=f"{where}.channel", problem=problem)
            for axis in axes:
                _take_on(exchange, axis, wire, robot.where)
            _wait_for_all(exchange, robot.where)
        except PortLost as lost:
            problem = f"{port}: {lost}; is the interface up? `ip link` shows those there are"
            raise ConfigurationError(where=f"{where}.channel", problem=problem) from None
        undo.pop_all()
    return exchange


def _wait_for_all(exchange: "DriveExchange", where: str) -> None:
    """Cycle until every drive is heard and measured."""
    until = time.monotonic() + _PATIENCE_S + exchange.deaf_ns / 1e9
    while unheard := [axis for axis in exchange.drives if axis.silent]:
        if time.monotonic() > until:
            axis = unheard[0]
            problem = f"node {axis.id} answers, but sends {axis.unheard}; a drive without it cannot be used"
            raise ConfigurationError(where=f'{where}: joint."{axis.joint.name}"', problem=problem)
        exchange.cycle()
        exchange.idle(exchange.period_ns / 1e9)
    for _ in range(_FIRST_CYCLES):
        exchange.cycle()


def _take_on(exchange: "DriveExchange", axis: "DriveAxis", wire: "CanPort", where: str) -> None:
    from trade_drivers.cia402._attach import Unfit  # noqa: PLC0415 - the libraries are optional
    from trade_drivers.cia402._net import NoAnswer, Refused  # noqa: PLC0415

    key = f'{where}: joint."{axis.joint.name}"'
    until = time.monotonic() + _PATIENCE_S
    while True:
        try:
            exchange.admit(axis)
        except NoAnswer as silent:
            if time.monotonic() < until:
                continue
            problem = (
                f"no drive answers as node {axis.id} on {wire.path} ({silent}); check its power and cable, its node "
                "id and bit rate, and the two terminations of the bus"
            )
            raise ConfigurationError(where=key, problem=problem) from None
        except Unfit as unfit:
            raise ConfigurationError(where=f"{key}{unfit.key}", problem=str(unfit)) from None
        except Refused as refused:
            raise ConfigurationError(where=key, problem=f"it refuses to be read: {refused}") from None
        return
