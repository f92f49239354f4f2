"""The base classes of drivers for motors on a CAN bus, and of scans for such motors."""

import time
from abc import abstractmethod
from collections.abc import Callable, Collection
from contextlib import ExitStack
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Final, Generic, TypeVar

from trade.errors import ConfigurationError, DeviceAbsent, WrongDevice
from trade_drivers._validation import not_installed
from trade_drivers.bus._can_monitor import CanMonitor
from trade_drivers.bus._jobs import NoAnswer
from trade_drivers.commissioning._commissioner import Bench, Commissioner
from trade_drivers.joints import AttachedJoints, BusMotor, BusThread, DeviceUnusable, PortLost, start_thread
from trade_drivers.joints.can._axis import DifferentMotor, MotorAxis
from trade_drivers.plugins._driver import AttachedBus, Driver
from trade_robotfile import Bus, CanBus, Joint, Robot

if TYPE_CHECKING:
    from trade_drivers.bus.can import CanPort, FramesById
    from trade_drivers.commissioning._can_scan import CanBench
    from trade_drivers.joints.can._cycle import MotorExchange

_PATIENCE_S: Final = 1.0
"""The time that a motor may need after power-on before it answers."""
_FIRST_CYCLES: Final = 5
"""The number of measurements needed to detect motion."""

_Motor = TypeVar("_Motor", bound=MotorAxis)
_Exchange = TypeVar("_Exchange", bound="MotorExchange[Any]")


class CanMotorCommissioner(Commissioner):
    """Motors on a CAN bus, given as ``INTERFACE:CHANNEL``; only the vendor's tool can set their ids."""

    wire = "can"
    bauds = (1_000_000,)
    """The system sets the rate of an interface; frames at another rate would disturb the bus."""
    libraries: ClassVar[str] = "python-can"
    ports = "is the interface up? `ip link show type can` lists the interfaces"

    @abstractmethod
    def bench(self) -> "type[CanBench]":
        """Returns the class of its bench; raises ImportError if a library is missing."""

    def open(self, port: str, baud: int) -> Bench:
        try:
            return self.bench().open(port, baud)
        except ImportError as missing:
            raise not_installed(self.driver, self.libraries, missing) from None


class CanMotorDriver(Driver, Generic[_Motor, _Exchange]):
    """The driver of one vendor's motors on a CAN bus, through python-can."""

    modules = ("can",)
    devices = (Joint,)
    name: ClassVar[str]
    models: ClassVar[Collection[str]]
    """Supported models, as printed on the motors; empty if all."""
    libraries: ClassVar[str] = "python-can"

    @abstractmethod
    def exchange_type(self) -> type[_Exchange]:
        """Returns the class of its exchange, imported now, as its libraries are optional."""

    @staticmethod
    @abstractmethod
    def orders(sniffed: "FramesById", nodes: Collection[int]) -> Collection[int]:
        """Returns the identifiers among the traffic that only another driver sends, to these nodes or any."""

    def check(self, robot: Robot, bus: Bus) -> None:
        can = self._can(robot, bus)
        self._built(robot, can, can.port)

    def attach(self, robot: Robot, bus: Bus, port: str, healthy: Callable[[], bool]) -> AttachedBus:
        exchange = self.open_exchange(robot, self._can(robot, bus), port)
        thread = start_thread(exchange, exchange.port, robot.name, bus, healthy)
        return AttachedMotors(thread, exchange.port, self.motor())

    def motor(self) -> type[BusMotor[Any, Any]]:
        """Returns the class of its motors."""
        return BusMotor

    @staticmethod
    def absent(exchange: _Exchange, where: str, problem: str) -> DeviceAbsent:
        """Returns the error for a motor that does not answer, with the state of a bus that is disturbed."""
        doubt = exchange.port.doubt
        return DeviceAbsent(where=where, problem=f"{problem}; {doubt}" if doubt else problem)

    def _can(self, robot: Robot, bus: Bus) -> CanBus:
        if not isinstance(bus, CanBus):
            problem = f"driver {self.name} needs a CAN bus: interface and channel instead of port"
            raise ConfigurationError(where=f"{robot.where}: bus.{bus.name}", problem=problem)
        return bus

    def _built(self, robot: Robot, bus: CanBus, port: str) -> _Exchange:
        """Returns the exchange described by the file; its port is closed."""
        self._check_models(robot, bus)
        nodes = [joint.id for joint in robot.joints_on(bus.name)]
        try:
            from trade_drivers.bus.can import CanPort  # noqa: PLC0415 - the libraries are optional

            where = f"{robot.where}: bus.{bus.name}"
            wire = CanPort.of(port, bus, where, partial(self.orders, nodes=nodes))
            kind = self.exchange_type()
        except ImportError as missing:
            raise not_installed(self.name, self.libraries, missing) from None
        axes = [
            kind.axis_type(f"{robot.name}.{joint.name}", port, joint, bus.rate_hz, robot.coupled_to(joint.name))
            for joint in robot.joints_on(bus.name)
        ]
        kind.check_bus(bus, axes, robot.where)
        return kind(wire, bus, axes)

    def _check_models(self, robot: Robot, bus: CanBus) -> None:
        for joint in robot.joints_on(bus.name):
            if self.models and joint.model not in self.models:
                problem = f"{joint.model!r} is not one of {', '.join(self.models)}"
                raise ConfigurationError(where=f'{robot.where}: joint."{joint.name}".model', problem=problem)

    def open_exchange(self, robot: Robot, bus: CanBus, port: str) -> _Exchange:
        """Opens the port and checks each motor without a thread; the caller must call ``cycle()``.

        Raises:
            ConfigurationError: the port cannot be opened, or a motor is absent, another, or cannot be used as it is.
        """
        where = f"{robot.where}: bus.{bus.name}"
        exchange = self._built(robot, bus, port)
        wire = exchange.port
        with ExitStack() as undo:
            undo.callback(wire.close)
            try:
                wire.open()
                exchange.on_open()
                self._bring_in(exchange, robot.where)
            except PortLost as lost:
                raise DeviceAbsent(where=f"{where}.channel", problem=f"{port}: {lost}") from None
            undo.pop_all()
        return exchange

    def _bring_in(self, exchange: _Exchange, where: str) -> None:
        """Runs cycles until each motor is accepted and measured."""
        until = time.monotonic() + _PATIENCE_S
        while away := [axis for axis in exchange.devices if axis.silent]:
            for axis in away:
                self.check_away(exchange, axis, where, last=time.monotonic() > until)
            exchange.cycle()
            exchange.idle(exchange.period_ns / 1e9)
        self.first_look(exchange)

    def first_look(self, exchange: _Exchange) -> None:
        """Runs cycles until motion of motors is detected."""
        for _ in range(_FIRST_CYCLES):
            exchange.cycle()
            exchange.idle(exchange.period_ns / 1e9)

    def check_away(self, exchange: _Exchange, axis: _Motor, where: str, *, last: bool) -> None:
        """Raises ``ConfigurationError`` for a motor that cannot be accepted; ``last``: ``DeviceAbsent`` if silent."""
        key = f'{where}: joint."{axis.joint.name}"'
        match exchange.problems.get(axis):
            case DifferentMotor() as other:
                name = other.key.removeprefix(".")
                raise WrongDevice(where=key, key=name, expected=other.expected, found=other.found)
            case DeviceUnusable() as unfit:
                raise ConfigurationError(where=f"{key}{unfit.key}", problem=str(unfit))
            case NoAnswer() if last:
                problem = (
                    f"no motor answers as {axis.id} on {axis.bus}; check its power and cable, its id and bit rate, "
                    "and the two terminations of the bus"
                )
                raise self.absent(exchange, key, problem)
            case NoAnswer():
                axis.probe_at_ns = exchange.clock()
            case _:
                pass


class AttachedMotors(AttachedJoints):
    """An attached bus of motors."""

    def __init__(
        self,
        thread: "BusThread[MotorExchange[Any]]",
        port: "CanPort",
        motor: type[BusMotor[Any, Any]] = BusMotor,
    ) -> None:
        super().__init__(thread, motor)
        self._port = port

    def monitor(self, name: str) -> CanMonitor:
        return CanMonitor(partial(self._port.look, name))


def check_load(bus: CanBus, where: str, devices: str, cycle_bits: float, other_bits: int = 0) -> None:
    """Raises ``ConfigurationError`` for a rate whose cycles, of so many bits, leave no room on the bus.

    Args:
        bus: the bus in the robot file.
        where: the robot file.
        devices: their number and name.
        cycle_bits: bits of one cycle.
        other_bits: bits per second that the devices send by themselves.
    """
    if cycle_bits * bus.rate_hz > bus.bitrate - other_bits:
        most_hz = max(0, bus.bitrate - other_bits) / cycle_bits
        problem = f"{devices} at {bus.bitrate} bit/s: at most {most_hz:.0f} Hz"
        raise ConfigurationError(where=f"{where}: bus.{bus.name}.rate_hz", problem=problem)
