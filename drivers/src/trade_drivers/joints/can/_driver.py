"""Bringing a bus of such motors up, and handing them out."""

import time
from abc import abstractmethod
from collections.abc import Callable, Collection
from contextlib import ExitStack
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Final

from trade.errors import ConfigurationError, WrongDevice
from trade_drivers.bus._jobs import NoAnswer
from trade_drivers.bus.can._monitor import CanMonitor
from trade_drivers.joints import AttachedJoints, BusThread, PortLost
from trade_drivers.joints.can._axis import Another, MotorAxis, Unfit
from trade_drivers.plugins._driver import AttachedBus, Driver
from trade_drivers.robotfile import Bus, CanBus, Joint, Robot

if TYPE_CHECKING:
    from trade_drivers.bus.can import CanPort, Talk
    from trade_drivers.joints.can._cycle import MotorExchange

__all__ = ["CanMotorDriver"]

_PATIENCE_S: Final = 1.0
"""A motor that has just been switched on needs a moment before it answers."""
_FIRST_CYCLES: Final = 5
"""As many measurements as it takes to see whether a joint moves."""


class CanMotorDriver(Driver):
    """One vendor's motors on a CAN bus, through python-can."""

    modules = ("can",)
    devices = (Joint,)
    name: ClassVar[str]
    models: ClassVar[Collection[str]]
    """What it knows, as printed on them."""

    @abstractmethod
    def exchange(self, robot: Robot, bus: CanBus, wire: "CanPort", port: str) -> "MotorExchange[Any]":
        """What the file alone can tell is checked; the port is not open yet. Raises ``ConfigurationError``."""

    @abstractmethod
    def orders(self, talk: "Talk", nodes: Collection[int]) -> Collection[int]:
        """Identifiers among what was heard that only another driver sends, to these nodes or any."""

    def check(self, robot: Robot, bus: Bus) -> None:
        can = self._can(robot, bus)
        self._built(robot, can, can.port)

    def attach(self, robot: Robot, bus: Bus, port: str, healthy: Callable[[], bool]) -> AttachedBus:
        with ExitStack() as undo:
            exchange = self.open_exchange(robot, bus := self._can(robot, bus), port)
            undo.callback(exchange.port.close)
            thread = BusThread(exchange, exchange.port, bus, healthy, name=f"bus {robot.name}.{bus.name}")
            thread.start()
            undo.pop_all()
        return _AttachedMotors(thread, exchange.port)

    def _can(self, robot: Robot, bus: Bus) -> CanBus:
        if not isinstance(bus, CanBus):
            problem = f"driver {self.name} needs a CAN bus: interface and channel instead of port"
            raise ConfigurationError(where=f"{robot.where}: bus.{bus.name}", problem=problem)
        return bus

    def _built(self, robot: Robot, bus: CanBus, port: str) -> "MotorExchange[Any]":
        """What it is driven by, out of the file; not open yet."""
        self._check_models(robot, bus)
        nodes = [joint.id for joint in robot.joints_on(bus.name)]
        return self.exchange(robot, bus, self._wire(port, bus, f"{robot.where}: bus.{bus.name}", nodes), port)

    def _check_models(self, robot: Robot, bus: CanBus) -> None:
        for joint in robot.joints_on(bus.name):
            if joint.model not in self.models:
                problem = f"{joint.model!r} is none of {', '.join(self.models)}"
                raise ConfigurationError(where=f'{robot.where}: joint."{joint.name}".model', problem=problem)

    def open_exchange(self, robot: Robot, bus: CanBus, port: str) -> "MotorExchange[Any]":
        """Open the port and look every motor over, without a thread: ``cycle()`` is the caller's to call.

        Raises:
            ConfigurationError: the port cannot be had, or a motor is absent, another, or cannot be used as it is.
        """
        where = f"{robot.where}: bus.{bus.name}"
        exchange = self._built(robot, bus, port)
        wire = exchange.port
        with ExitStack() as undo:
            undo.callback(wire.close)
            try:
                wire.open()
                self._bring_in(exchange, robot.where)
            except PortLost as lost:
                problem = f"{port}: {lost}; is the interface up? `ip link` shows those there are"
                raise ConfigurationError(where=f"{where}.channel", problem=problem) from None
            undo.pop_all()
        return exchange

    def _wire(self, port: str, bus: CanBus, where: str, nodes: Collection[int]) -> "CanPort":
        try:
            from trade_drivers.bus.can import CanPort  # noqa: PLC0415 - python-can is optional
        except ImportError as missing:
            problem = f'needs python-can ({missing}); pip install "trade-drivers[{self.name}]"'
            raise ConfigurationError(where=f"driver {self.name}", problem=problem) from None
        return CanPort.of(port, bus, where, partial(self.orders, nodes=nodes))

    def _bring_in(self, exchange: "MotorExchange[Any]", where: str) -> None:
        """Cycle until every motor is taken on and measured."""
        until = time.monotonic() + _PATIENCE_S
        while away := [axis for axis in exchange.motors if axis.silent]:
            for axis in away:
                self._check(exchange, axis, where, last=time.monotonic() > until)
            exchange.cycle()
            exchange.idle(exchange.period_ns / 1e9)
        for _ in range(_FIRST_CYCLES):
            exchange.cycle()
            exchange.idle(exchange.period_ns / 1e9)

    def _check(self, exchange: "MotorExchange[Any]", axis: MotorAxis, where: str, *, last: bool) -> None:
        key = f'{where}: joint."{axis.joint.name}"'
        match exchange.problems.get(axis):
            case Another() as other:
                name = other.key.removeprefix(".")
                raise WrongDevice(where=key, key=name, expected=other.expected, found=other.found)
            case Unfit() as unfit:
                raise ConfigurationError(where=f"{key}{unfit.key}", problem=str(unfit))
            case NoAnswer() if last:
                problem = (
                    f"no motor answers as {axis.id} on {axis.bus}; check its power and cable, its id and bit rate, "
                    "and the two terminations of the bus"
                )
                raise ConfigurationError(where=key, problem=problem)
            case NoAnswer():
                axis.probe_at_ns = exchange.clock()
            case _:
                pass


class _AttachedMotors(AttachedJoints):
    """A bus of motors."""

    def __init__(self, thread: "BusThread[MotorExchange[Any]]", port: "CanPort") -> None:
        super().__init__(thread)
        self._port = port

    def monitor(self, name: str) -> CanMonitor:
        return CanMonitor(partial(self._port.look, name))
