"""The driver of a bus of grippers."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final, NoReturn

import trade_robotfile
from trade.errors import ConfigurationError, DeviceAbsent
from trade_drivers._validation import not_installed
from trade_drivers.bus._attempts import attempts
from trade_drivers.bus._jobs import NoAnswer, Refused
from trade_drivers.bus._thread import BusThread, opening, start_thread
from trade_drivers.interfaces._motion import Gripper, JointGroup, Motor
from trade_drivers.plugins._driver import AttachedBus, Driver, ThreadedBus
from trade_drivers.vendors.robotiq import _table as table
from trade_drivers.vendors.robotiq._commission import RobotiqCommissioner
from trade_drivers.vendors.robotiq._cycle import Exchange
from trade_drivers.vendors.robotiq._gripper import RobotiqGripper
from trade_drivers.vendors.robotiq._gripper_state import GripperDevice
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


class AttachedGrippers(ThreadedBus[Exchange]):
    """A bus with its grippers and its owner thread."""

    def __init__(self, thread: BusThread[Exchange]) -> None:
        super().__init__(thread)
        self._hands = {hand.gripper.name: hand for hand in thread.exchange.hands}

    def motor(self, joint: str) -> Motor:
        raise ConfigurationError(where=f'joint."{joint}"', problem="driver robotiq has no joints, only grippers")

    def group(self, name: str, joints: Sequence[str]) -> JointGroup:
        raise ConfigurationError(where=name, problem=f"driver robotiq has no joints such as {', '.join(joints)}")

    def gripper(self, name: str) -> Gripper:
        return RobotiqGripper(self._thread, self._hands[name])


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
        wire_at(serial.port, serial.baud, f"{robot.where}: bus.{bus.name}")

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
    hands = [GripperDevice(f"{robot.name}.{gripper.name}", port, gripper) for gripper in robot.grippers_on(bus.name)]
    where = f"{robot.where}: bus.{bus.name}"
    wire = wire_at(port, bus.baud, where)
    exchange = Exchange(wire, bus, hands)
    with opening(wire, port, where):
        for hand in hands:
            _look_over(exchange, hand, bus, robot.where)
        for hand in hands:
            exchange.admit(hand)
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


def _look_over(exchange: Exchange, hand: GripperDevice, bus: SerialBus, where: str) -> None:
    """Takes a gripper's first measurements; writes nothing."""
    key = f'{where}: gripper."{hand.gripper.name}"'
    for _ in attempts(exchange.clock, exchange.stale_after_ns):
        try:
            exchange.probe(hand)
            exchange.read(hand)
            exchange.read(hand)  # two measurements show motion
        except NoAnswer:
            continue
        except Refused as refused:
            _wrong(key, f"what answers on bus {bus.name!r} is no 2F-85: {refused}")
        if hand.sample is not None and not hand.sample.plausible:
            _wrong(key, f"what answers to id {hand.id} on bus {bus.name!r} is no 2F-85: its status makes no sense")
        hand.silent = False
        return
    problem = (
        f"no gripper answers to id {hand.id} on bus {bus.name!r} ({exchange.wire.path}, {bus.baud} baud); check its "
        "power and cable, its id and its baud rate with the vendor's tool"
    )
    raise DeviceAbsent(where=key, problem=problem)


def wire_at(port: str, baud: int, where: str) -> "Wire":
    """Returns a closed line. Raises ``ConfigurationError`` without the vendor library."""
    try:
        from trade_drivers.vendors.robotiq._wire import Wire  # noqa: PLC0415 - the vendor library is optional
    except ImportError as missing:
        raise not_installed("robotiq", "pymodbus", missing) from None
    return Wire(port, baud, where)


def _wrong(where: str, problem: str) -> NoReturn:
    raise ConfigurationError(where=where, problem=problem)
