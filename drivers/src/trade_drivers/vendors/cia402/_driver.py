"""Bringing a bus of CiA 402 drives up, and handing out its motors."""

import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from typing import TYPE_CHECKING, Final

from trade.errors import ConfigurationError, WrongDevice
from trade_drivers.joints import BusThread, PortLost
from trade_drivers.plugins._driver import AttachedBus, Driver
from trade_drivers.robotfile import Bus, CanBus, Joint, Robot
from trade_drivers.vendors.cia402._commission import Cia402Commissioner

if TYPE_CHECKING:
    from trade_drivers.vendors.cia402._admission import Admission
    from trade_drivers.vendors.cia402._axis import DriveAxis
    from trade_drivers.vendors.cia402._cycle import DriveExchange

__all__ = ["Cia402Driver", "open_exchange"]

_PATIENCE_S: Final = 1.0
"""A drive that has just been switched on needs a moment before it answers."""
_FIRST_CYCLES: Final = 3
"""As many measurements as it takes to see whether a joint moves."""


class Cia402Driver(Driver):
    """Drives in profile position mode on a CAN bus, through python-can and canopen."""

    modules = ("can", "canopen")
    devices = (Joint,)
    commissioner = Cia402Commissioner

    def check(self, robot: Robot, bus: Bus) -> None:
        can = _can(robot, bus)
        _axes(robot, can, can.port)

    def attach(self, robot: Robot, bus: Bus, port: str, healthy: Callable[[], bool]) -> AttachedBus:
        with ExitStack() as undo:
            exchange = open_exchange(robot, _can(robot, bus), port)
            undo.callback(exchange.port.close)
            thread = BusThread(exchange, exchange.port, bus, healthy, name=f"bus {robot.name}.{bus.name}")
            thread.start()
            undo.pop_all()
        from trade_drivers.vendors.cia402._motor import AttachedDrives  # noqa: PLC0415 - the libraries are optional

        return AttachedDrives(thread, exchange.port)


def _can(robot: Robot, bus: Bus) -> CanBus:
    if not isinstance(bus, CanBus):
        problem = "driver cia402 needs a CAN bus: interface and channel instead of port"
        raise ConfigurationError(where=f"{robot.where}: bus.{bus.name}", problem=problem)
    return bus


def _axes(robot: Robot, bus: CanBus, port: str) -> "list[DriveAxis]":
    """The drives of a bus, as far as the file tells."""
    try:
        from trade_drivers.vendors.cia402._axis import DriveAxis  # noqa: PLC0415
        from trade_drivers.vendors.cia402._inspect import check_bus  # noqa: PLC0415 - the libraries are optional
    except ImportError as missing:
        problem = f'needs canopen and python-can ({missing}); pip install "trade-drivers[cia402]"'
        raise ConfigurationError(where="driver cia402", problem=problem) from None
    axes = [
        DriveAxis(f"{robot.name}.{joint.name}", port, joint, bus.rate_hz, robot.coupled_to(joint.name))
        for joint in robot.joints_on(bus.name)
    ]
    check_bus(bus, axes, robot.where)
    return axes


def open_exchange(robot: Robot, bus: CanBus, port: str) -> "DriveExchange":
    """Open the port and look every drive over, without a thread: ``cycle()`` is the caller's to call.

    Raises:
        ConfigurationError: the port cannot be had, or a drive is absent, another, or cannot be used as it is.
    """
    axes = _axes(robot, bus, port)
    from trade_drivers.bus.can import CanPort  # noqa: PLC0415 - the libraries are optional
    from trade_drivers.vendors.cia402 import _table as table  # noqa: PLC0415
    from trade_drivers.vendors.cia402._cycle import DriveExchange  # noqa: PLC0415

    where = f"{robot.where}: bus.{bus.name}"
    nodes = [axis.id for axis in axes]
    wire = CanPort.of(port, bus, where, partial(table.orders, nodes=nodes))
    with ExitStack() as undo:
        undo.callback(wire.close)
        try:
            wire.open()
            exchange = DriveExchange(wire, bus, axes)
            for axis in axes:
                for data in wire.talk.frames.get(table.HEARTBEAT + axis.id, ()):
                    axis.take_heartbeat(data, exchange.clock())
            _bring_in(exchange, robot.where)
        except PortLost as lost:
            problem = f"{port}: {lost}; is the interface up? `ip link` shows those there are"
            raise ConfigurationError(where=f"{where}.channel", problem=problem) from None
        undo.pop_all()
    return exchange


def _bring_in(exchange: "DriveExchange", where: str) -> None:
    """Cycle until every drive is taken on, heard and measured.

    Raises:
        ConfigurationError: one of them is not; names its joint, and what to check.
    """
    until = time.monotonic() + _PATIENCE_S
    while away := [admission for admission in exchange.admissions if admission.axis.silent]:
        for admission in away:
            _check(admission, where, last=time.monotonic() > until)
            admission.recall()
        exchange.cycle()
        exchange.idle(exchange.period_ns / 1e9)
    for _ in range(_FIRST_CYCLES):
        exchange.cycle()


def _check(admission: "Admission", where: str, *, last: bool) -> None:
    from trade_drivers.vendors.cia402._axis import Stage  # noqa: PLC0415
    from trade_drivers.vendors.cia402._inspect import Another, Unfit  # noqa: PLC0415 - the libraries are optional
    from trade_drivers.vendors.cia402._net import NoAnswer, Refused  # noqa: PLC0415

    axis = admission.axis
    key = f'{where}: joint."{axis.joint.name}"'
    match admission.problem:
        case Another() as other:
            name = other.key.removeprefix(".")
            raise WrongDevice(where=key, key=name, expected=other.expected, found=other.found)
        case Unfit() as unfit:
            raise ConfigurationError(where=f"{key}{unfit.key}", problem=str(unfit))
        case Refused() as refused:
            raise ConfigurationError(where=key, problem=f"it refuses to be read: {refused}")
        case NoAnswer() as silent if last and axis.stage is Stage.AWAY:
            problem = (
                f"no drive answers as node {axis.id} on {axis.bus} ({silent}); check its power and cable, its node "
                "id and bit rate, and the two terminations of the bus"
            )
            raise ConfigurationError(where=key, problem=problem)
        case _:
            pass
