"""The base class of drivers for servos on a serial bus."""

from abc import abstractmethod
from collections.abc import Callable, Collection, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar, cast

from trade.errors import ConfigurationError
from trade_drivers.bus._thread import opening
from trade_drivers.commissioning._commissioner import Bench
from trade_drivers.joints import AttachedJoints, start_thread
from trade_drivers.joints.serial._axis import ServoAxis
from trade_drivers.joints.serial._commission import ServoBench
from trade_drivers.joints.serial._cycle import ServoExchange
from trade_drivers.joints.serial._inspect import PersistentRegisters, first_look
from trade_drivers.plugins._driver import AttachedBus, Driver
from trade_robotfile import Bus, Gripper, Joint, Robot, SerialBus

if TYPE_CHECKING:
    from trade_drivers.joints.serial._wire import ServoWire

_Servo = TypeVar("_Servo", bound=ServoAxis[Any])
_Wire = TypeVar("_Wire", bound="ServoWire")


class ServoDriver(Driver, Generic[_Servo, _Wire]):
    """The driver of one vendor's servos in position control on a serial bus."""

    devices = (Joint,)
    name: ClassVar[str]
    models: ClassVar[Mapping[str, object]]
    """Supported models by the name printed on them."""
    bauds: ClassVar[Collection[int]]
    """Supported baud rates."""
    kept: ClassVar[PersistentRegisters]
    """The layout of their persistent registers."""

    @abstractmethod
    def exchange(self, robot: Robot, bus: SerialBus, port: str, joints: list[Joint]) -> ServoExchange[_Servo, _Wire]:
        """Checks the file and returns an exchange with a closed port. Raises ``ConfigurationError``."""

    def verify(
        self, exchange: ServoExchange[_Servo, _Wire], wire: _Wire, bus: SerialBus, axis: _Servo, where: str
    ) -> bytes:
        """Checks one joint's device and takes its first measurements. Moves and resets nothing.

        Returns:
            The bytes of its persistent registers, from address 0.

        Raises:
            ConfigurationError: the device is absent, another model, set wrongly, or shares its id.
            NoAnswer: the device answers a ping, but no read.
        """
        key = f'{where}: joint."{axis.joint.name}"'
        settings = first_look(wire, bus, axis, self.kept, exchange.clock, key)
        exchange.check_settings(axis, settings, key)
        return settings

    def check(self, robot: Robot, bus: Bus) -> None:
        serial = self._serial(robot, bus)
        self.exchange(robot, serial, serial.port, self._known(robot, serial))

    def fits(self, bench: Bench, robot: Robot, bus: Bus, device: Joint | Gripper) -> None:
        serial, wire = self._serial(robot, bus), cast("ServoBench[_Wire]", bench).wire
        exchange = self.exchange(robot, serial, serial.port, [cast("Joint", device)])
        [axis] = exchange.devices
        self.verify(exchange, wire, serial, axis, robot.where)
        if problem := axis.unheld:
            raise ConfigurationError(where=f'{robot.where}: joint."{axis.joint.name}"', problem=problem)

    def attach(self, robot: Robot, bus: Bus, port: str, healthy: Callable[[], bool]) -> AttachedBus:
        exchange = self.open_exchange(robot, self._serial(robot, bus), port)
        return AttachedJoints(start_thread(exchange, exchange.wire, robot.name, bus, healthy))

    def open_exchange(self, robot: Robot, bus: SerialBus, port: str) -> ServoExchange[_Servo, _Wire]:
        """Opens the port and checks each joint without a thread; the caller must call ``cycle()``.

        Raises:
            ConfigurationError: the port cannot be opened, or a device is absent, another, or set wrongly.
        """
        exchange = self.exchange(robot, bus, port, self._known(robot, bus))
        with opening(exchange.wire, port, f"{robot.where}: bus.{bus.name}"):
            for axis in exchange.devices:
                self.verify(exchange, exchange.wire, bus, axis, robot.where)
            for axis in exchange.devices:
                exchange.admit(axis)
            exchange.cycle()
        return exchange

    def _serial(self, robot: Robot, bus: Bus) -> SerialBus:
        if not isinstance(bus, SerialBus):
            problem = f"driver {self.name} needs a serial bus: port instead of interface and channel"
            raise ConfigurationError(where=f"{robot.where}: bus.{bus.name}", problem=problem)
        return bus

    def _known(self, robot: Robot, bus: SerialBus) -> list[Joint]:
        if bus.baud not in self.bauds:
            problem = f"{bus.baud} is no rate of these servos; they know {', '.join(map(str, sorted(self.bauds)))}"
            raise ConfigurationError(where=f"{robot.where}: bus.{bus.name}.baud", problem=problem)
        joints = robot.joints_on(bus.name)
        for joint in joints:
            if joint.model not in self.models:
                problem = f"{joint.model!r} is unknown to the driver {self.name}; it supports {', '.join(self.models)}"
                raise ConfigurationError(where=f'{robot.where}: joint."{joint.name}".model', problem=problem)
            if joint.counts_per_rev is not None or joint.gear != 1:
                problem = "counts_per_rev and gear are for other devices: a servo's angle is that of its joint"
                raise ConfigurationError(where=f'{robot.where}: joint."{joint.name}"', problem=problem)
            if joint.zero is not None:
                problem = "leave this key out: a servo knows its angle within its one turn, whatever its power does"
                raise ConfigurationError(where=f'{robot.where}: joint."{joint.name}".zero', problem=problem)
            if joint.serial_number is not None:
                problem = "these servos report no serial number; remove this key"
                raise ConfigurationError(where=f'{robot.where}: joint."{joint.name}".serial_number', problem=problem)
        return joints
