"""The driver of a bus of grippers, their services, and the scan for them."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final, NoReturn

import trade_robotfile
from trade import Resource
from trade.errors import ConfigurationError, DeviceAbsent, DeviceSilent
from trade_drivers._validation import finite, not_installed, within
from trade_drivers.bus._attempts import attempts
from trade_drivers.bus._gate import admitted, at_once, span
from trade_drivers.bus._jobs import NoAnswer, RequestRefused
from trade_drivers.bus._thread import BusThread, opening, start_thread
from trade_drivers.commissioning._commissioner import Bench, Commissioner, ScannedDevice
from trade_drivers.interfaces._motion import Gripper, GripperLimits, GripperState, JointGroup, Motor
from trade_drivers.plugins._driver import AttachedBus, Driver, ThreadedBus
from trade_drivers.vendors.robotiq import _table as table
from trade_drivers.vendors.robotiq._exchange import Activate, ClearFault, Exchange, GripperCommand, Move
from trade_drivers.vendors.robotiq._gripper import GripperDevice
from trade_robotfile import Bus, Robot, SerialBus

if TYPE_CHECKING:
    from trade_drivers.vendors.robotiq._wire import Wire

_BITS_A_READ: Final = (8 + 11) * 10 + 35
"""Request, answer, and the gap of three and a half characters before it."""

_MEANINGLESS: Final = {
    "watchdog_s": "a 2F-85 has no watchdog: left alone, it completes its last move; leave this key out",
    "fast_sync": "a 2F-85 has no joined answers: each is read by itself; leave this key out",
}
"""Keys of a serial bus that grippers do not support, and why."""


class RobotiqGripper(Gripper):
    """One gripper of a bus. It checks arguments, queues a job for the bus thread, and waits for it."""

    def __init__(self, thread: BusThread[Exchange], device: GripperDevice) -> None:
        self._thread = thread
        self._exchange = thread.exchange
        self._device = device
        self._name = device.name

    @property
    def resources(self) -> tuple[Resource, ...]:
        return (self._device.resource,)

    def state(self) -> GripperState:
        exchange = self._exchange
        try:
            return self._device.state(exchange.clock(), exchange.stale_after_ns)
        except DeviceSilent as silent:
            raise exchange.absence(self._device, silent) from None

    def limits(self) -> GripperLimits:
        gripper, model = self._device.gripper, self._device.model
        return GripperLimits(
            name=self._name,
            min_width_m=gripper.min_width_m,
            max_width_m=gripper.max_width_m,
            min_speed_m_s=model.speeds_m_s[0],
            max_speed_m_s=gripper.max_speed_m_s,
            min_force_n=model.forces_n[0],
            max_force_n=gripper.max_force_n,
        )

    def activate(self) -> GripperState:
        with admitted(f"{self._name}.activate", self.resources, span(self._exchange.clock)) as terms:
            self._finish(Activate(self._exchange, [self._device], terms))
        return self.state()

    def move_to(self, width_m: float, speed_m_s: float | None = None, force_n: float | None = None) -> GripperState:
        return self._move("move_to", width_m, speed_m_s, force_n)

    def open(self, speed_m_s: float | None = None) -> GripperState:
        return self._move("open", self._device.gripper.max_width_m, speed_m_s, None)

    def close(self, speed_m_s: float | None = None, force_n: float | None = None) -> GripperState:
        return self._move("close", self._device.gripper.min_width_m, speed_m_s, force_n)

    def stop(self) -> None:
        self._exchange.stop([self._device]).wait(self._thread.alive)

    def clear_fault(self) -> None:
        with admitted(f"{self._name}.clear_fault", self.resources, at_once(self._exchange.clock)) as terms:
            self._finish(ClearFault(self._exchange, [self._device], terms))

    def _move(self, name: str, width_m: float, speed_m_s: float | None, force_n: float | None) -> GripperState:
        service, limits, model = f"{self._name}.{name}", self.limits(), self._device.model
        width = finite(width_m, service, "width_m")
        within(width, limits.min_width_m, limits.max_width_m, f"{self._name} width", "m")
        speed = limits.max_speed_m_s if speed_m_s is None else finite(speed_m_s, service, "speed_m_s")
        within(speed, limits.min_speed_m_s, limits.max_speed_m_s, f"{self._name} speed", "m/s")
        force = limits.max_force_n if force_n is None else finite(force_n, service, "force_n")
        within(force, limits.min_force_n, limits.max_force_n, f"{self._name} force", "N")
        registers = table.command(model.counts(width), model.speed_counts(speed), model.force_counts(force))
        with admitted(service, self.resources, span(self._exchange.clock)) as terms:
            self._finish(Move(self._exchange, [self._device], registers, terms))
        return self.state()

    def _finish(self, job: GripperCommand) -> None:
        self._exchange.submit(job)
        job.wait(self._thread.alive)


class RobotiqCommissioner(Commissioner):
    """2F-85 grippers; they leave the factory with id 9 at 115200 baud."""

    driver = "robotiq"
    bauds = (115_200,)
    ids = range(1, 248)

    def open(self, port: str, baud: int) -> Bench:
        wire = _wire_at(port, baud, "")
        wire.open()
        return RobotiqBench(wire, port, baud)


class RobotiqBench(Bench):
    """An open line of 2F-85 grippers."""

    def __init__(self, wire: "Wire", port: str, baud: int) -> None:
        self._wire, self._port, self._baud = wire, port, baud

    def anybody(self) -> bool:
        return True

    def look(self, device_id: int) -> ScannedDevice | None:
        try:
            status = table.Status.decode(self._wire.read(device_id), 0)
        except NoAnswer:
            self._wire.settled_at = 0.0  # a late answer must not be taken for that of the next id
            return None
        except RequestRefused:
            return self._found(device_id, "", "it is a Modbus device, but no 2F-85")
        if not status.plausible:
            return self._found(device_id, "", "it has the registers of a 2F-85, but what they read makes no sense")
        return self._found(device_id, "2F-85", "")

    def _found(self, device_id: int, model: str, problem: str) -> ScannedDevice:
        return ScannedDevice(
            driver="robotiq", kind="gripper", baud=self._baud, id=device_id, model=model, problem=problem
        )

    def angle_rad(self, device_id: int) -> NoReturn:
        self._cannot(device_id, "a gripper has no angle; its widths are known, so there is nothing to calibrate")

    def write_id(self, device_id: int, to: int) -> NoReturn:  # noqa: ARG002
        self._cannot(device_id, "the id of a 2F-85 is set by the vendor's tool alone (Robotiq User Interface)")

    def write_baud(self, device_id: int, to: int) -> NoReturn:  # noqa: ARG002
        self._cannot(device_id, "the baud rate of a 2F-85 is set by the vendor's tool alone (Robotiq User Interface)")

    def seal(self, device_id: int) -> None:
        """Does nothing, as this bench unlocks no registers."""

    def _cannot(self, device_id: int, problem: str) -> NoReturn:
        raise ConfigurationError(where=f"{self._port}, id {device_id}", problem=problem)

    def close(self) -> None:
        self._wire.close()


class AttachedGrippers(ThreadedBus[Exchange]):
    """A bus with its grippers and its owner thread."""

    def __init__(self, thread: BusThread[Exchange]) -> None:
        super().__init__(thread)
        self._devices = {device.gripper.name: device for device in thread.exchange.devices}

    def motor(self, joint: str) -> Motor:
        raise ConfigurationError(where=f'joint."{joint}"', problem="driver robotiq has no joints, only grippers")

    def group(self, name: str, joints: Sequence[str]) -> JointGroup:
        raise ConfigurationError(where=name, problem=f"driver robotiq has no joints such as {', '.join(joints)}")

    def gripper(self, name: str) -> Gripper:
        return RobotiqGripper(self._thread, self._devices[name])


class RobotiqDriver(Driver):
    """2F-85 grippers on a serial bus, through pymodbus.

    In a robot file::

        [bus.hand]
        driver = "robotiq"
        port = "/dev/serial/by-id/usb-FTDI_USB_TO_RS-485-if00-port0"
        baud = 115200

        [gripper.hand]
        bus = "hand"
        id = 9
        model = "2F-85"
        max_width_m = 0.085
        max_speed_m_s = 0.15
        max_force_n = 100.0
    """

    modules = ("pymodbus", "serial")
    devices = (trade_robotfile.Gripper,)
    without_watchdog = "no watchdog: without its driver it completes its last stroke"
    commissioner = RobotiqCommissioner

    def check(self, robot: Robot, bus: Bus) -> None:
        serial = _serial(robot, bus)
        _check(robot, serial)
        _wire_at(serial.port, serial.baud, f"{robot.where}: bus.{bus.name}")

    def attach(self, robot: Robot, bus: Bus, port: str, healthy: Callable[[], bool]) -> AttachedBus:
        exchange = open_exchange(robot, _serial(robot, bus), port)
        return AttachedGrippers(start_thread(exchange, exchange.wire, robot.name, bus, healthy))


def _serial(robot: Robot, bus: Bus) -> SerialBus:
    if not isinstance(bus, SerialBus):
        _wrong(f"{robot.where}: bus.{bus.name}", "driver robotiq needs a serial bus: a port, no channel")
    return bus


def open_exchange(robot: Robot, bus: SerialBus, port: str) -> Exchange:
    """Opens the port and checks each gripper without a thread; the caller must call ``cycle()``.

    Raises:
        ConfigurationError: the port cannot be opened, or a gripper is absent, another device, or set wrongly.
    """
    _check(robot, bus)
    devices = [GripperDevice(f"{robot.name}.{gripper.name}", port, gripper) for gripper in robot.grippers_on(bus.name)]
    where = f"{robot.where}: bus.{bus.name}"
    wire = _wire_at(port, bus.baud, where)
    exchange = Exchange(wire, bus, devices)
    with opening(wire, port, where):
        for device in devices:
            _verify(exchange, device, bus, robot.where)
        for device in devices:
            exchange.admit(device)
        exchange.cycle()
    return exchange


def _check(robot: Robot, bus: SerialBus) -> None:
    """Checks the robot file: models, limits, and whether a cycle is long enough for its bytes."""
    where, grippers = f"{robot.where}: bus.{bus.name}", robot.grippers_on(bus.name)
    for gripper in grippers:
        key = f'{robot.where}: gripper."{gripper.name}"'
        model = table.BY_MODEL_NAME.get(gripper.model)
        if model is None:
            known = ", ".join(table.BY_MODEL_NAME)
            _wrong(f"{key}.model", f"{gripper.model!r} is unknown to the driver robotiq; it knows {known}")
        for name, value, (low, high) in (
            ("max_width_m", gripper.max_width_m, (0.0, model.stroke_m)),
            ("max_speed_m_s", gripper.max_speed_m_s, model.speeds_m_s),
            ("max_force_n", gripper.max_force_n, model.forces_n),
        ):
            if not low <= value <= high:
                _wrong(f"{key}.{name}", f"{value:g} is outside of what a {model.name} can: {low:g} to {high:g}")
    for key, problem in _MEANINGLESS.items():
        if key in robot.given.get(bus.name, ()):
            _wrong(f"{where}.{key}", problem)
    if bus.baud not in table.BAUDS:
        known = ", ".join(map(str, table.BAUDS))
        _wrong(
            f"{where}.baud", f"{bus.baud} is no rate of a 2F-85; it knows {known}, and leaves the factory with 115200"
        )
    if bus.leave != "hold":
        problem = '"relax" is nothing a 2F-85 can: its fingers stand without power, too; use "hold"'
        _wrong(f"{where}.leave", problem)
    cycle_s = len(grippers) * _BITS_A_READ / bus.baud
    if cycle_s * bus.rate_hz > 1:
        problem = f"{len(grippers)} grippers at {bus.baud} baud need {cycle_s * 1e3:.1f} ms a cycle"
        _wrong(f"{where}.rate_hz", f"{problem}: at most {1 / cycle_s:.0f} Hz")


def _verify(exchange: Exchange, device: GripperDevice, bus: SerialBus, where: str) -> None:
    """Takes a gripper's first measurements; writes nothing."""
    key = f'{where}: gripper."{device.gripper.name}"'
    for _ in attempts(exchange.clock, exchange.stale_after_ns):
        try:
            exchange.probe(device)
            exchange.read(device)
            exchange.read(device)  # two measurements show motion
        except NoAnswer:
            continue
        except RequestRefused as refused:
            _wrong(key, f"what answers on bus {bus.name!r} is no 2F-85: {refused}")
        if device.sample is not None and not device.sample.plausible:
            _wrong(key, f"what answers to id {device.id} on bus {bus.name!r} is no 2F-85: its status makes no sense")
        device.silent = False
        return
    problem = (
        f"no gripper answers to id {device.id} on bus {bus.name!r} ({exchange.wire.path}, {bus.baud} baud); check its "
        "power and cable, its id and its baud rate with the vendor's tool"
    )
    raise DeviceAbsent(where=key, problem=problem)


def _wire_at(port: str, baud: int, where: str) -> "Wire":
    """Returns a closed line. Raises ``ConfigurationError`` without the vendor library."""
    try:
        from trade_drivers.vendors.robotiq._wire import Wire  # noqa: PLC0415 - the vendor library is optional
    except ImportError as missing:
        raise not_installed("robotiq", "pymodbus", missing) from None
    return Wire(port, baud, where)


def _wrong(where: str, problem: str) -> NoReturn:
    raise ConfigurationError(where=where, problem=problem)
