"""The driver of a Feetech bus, and the setting up of its servos."""

from typing import TYPE_CHECKING, Final

from trade.errors import ConfigurationError
from trade_drivers._validation import not_installed
from trade_drivers.commissioning._commissioner import Bench, Commissioner
from trade_drivers.joints import DeviceUnusable, check_joints
from trade_drivers.joints.serial import PersistentRegisters, ServoBench, ServoDriver, check_cycle, check_ranges
from trade_drivers.vendors.feetech import _table as table
from trade_drivers.vendors.feetech._axis import CYCLIC, RESOLUTION, FeetechAxis
from trade_drivers.vendors.feetech._exchange import GOAL_BLOCK, FeetechExchange
from trade_robotfile import Joint, Robot, SerialBus

if TYPE_CHECKING:
    from trade_drivers.vendors.feetech._wire import Wire

_MOST_SPEED_COUNTS: Final = ((1 << 15) - 1) // table.STEPS_PER_SPEED
_OPEN, _SHUT = 0, 1


class FeetechCommissioner(Commissioner):
    """STS servos; they leave the factory with id 1 at 1 Mbaud."""

    driver = "feetech"
    bauds = tuple(table.BAUD_CODES)
    ids = range(254)

    def open(self, port: str, baud: int) -> Bench:
        wire = _wire_at(port, baud, "")
        wire.open()
        return FeetechBench(wire, baud)


class FeetechBench(ServoBench["Wire"]):
    """An open line of Feetech servos."""

    driver = "feetech"
    restless = (table.PRESENT_POSITION.address, table.MOVING.end - table.PRESENT_POSITION.address)
    mute = "it reports its model and nothing else; check its cable"
    resolution = RESOLUTION
    torque, position, homing = table.TORQUE, table.PRESENT_POSITION, table.HOMING_OFFSET

    def model_of(self, number: int) -> str:
        return table.name_of(number, "")

    def firmware_of(self, device_id: int) -> str:
        return table.firmware(self.wire.read(device_id, table.MAJOR.address, table.MINOR.end).data)

    def write_id(self, device_id: int, to: int) -> None:
        self._opened(device_id, table.ID, to)

    def write_baud(self, device_id: int, to: int) -> None:
        self._opened(device_id, table.BAUD, table.BAUD_CODES[to])

    def seal(self, device_id: int) -> None:
        self.write(device_id, table.LOCK, _SHUT)

    def _opened(self, device_id: int, register: table.Register, value: int) -> None:
        """Writes a register persistently."""
        self.write(device_id, table.LOCK, _OPEN)
        self.write(device_id, register, value)


class FeetechDriver(ServoDriver[FeetechAxis, "Wire"]):
    """STS servos in position control on a serial bus.

    In a robot file::

        [bus.arm]
        driver = "feetech"
        port = "/dev/serial/by-id/usb-1a86_USB_Single_Serial_58FA083324-if00"
        baud = 1_000_000

        [joint.elbow]
        bus = "arm"
        id = 3
        model = "STS3215"
        min_rad = -1.4
        max_rad = 1.4
        max_speed_rad_s = 2.5
        max_accel_rad_s2 = 20.0
    """

    name = "feetech"
    models = table.BY_MODEL_NAME
    bauds = table.BAUD_CODES
    kept = PersistentRegisters((table.ID.address, table.BAUD.address), table.name_of, table.firmware)
    modules = ("serial",)
    without_watchdog = "no watchdog: without its driver it continues to its last goal, which is never far ahead"
    commissioner = FeetechCommissioner

    def exchange(self, robot: Robot, bus: SerialBus, port: str, joints: list[Joint]) -> FeetechExchange:
        axes = [
            FeetechAxis(f"{robot.name}.{joint.name}", port, joint, bus.watchdog_s, robot.coupled_to(joint.name))
            for joint in joints
        ]
        where = f"{robot.where}: bus.{bus.name}"
        if "fast_sync" in robot.given.get(bus.name, ()):
            problem = "these servos have no joined answers; leave this key out"
            raise ConfigurationError(where=f"{where}.fast_sync", problem=problem)
        check_joints(axes, robot.where, check_ranges)
        check_joints(axes, robot.where, _check_most)
        _check_cycle(bus, len(axes), robot.where)
        return FeetechExchange(_wire_at(port, bus.baud, where), bus, axes)


def _check_most(axis: FeetechAxis) -> None:
    joint = axis.joint
    for key, value, most in (
        (".max_speed_rad_s", joint.max_speed_rad_s, _MOST_SPEED_COUNTS * table.RAD_S_PER_COUNT),
        (".max_accel_rad_s2", joint.max_accel_rad_s2, table.MOST_ACCELERATION * table.RAD_S2_PER_COUNT),
    ):
        if value > most:
            raise DeviceUnusable(f"{value:.4g} is above {most:.4g}, the most an {joint.model} can be set to", key)


def _check_cycle(bus: SerialBus, count: int, where: str) -> None:
    asked = table.OVERHEAD + 2 + count + count * (table.OVERHEAD + CYCLIC[1])
    check_cycle(bus, count, asked + table.OVERHEAD + 2 + count * (1 + GOAL_BLOCK[1]), where)


def _wire_at(port: str, baud: int, where: str) -> "Wire":
    """Returns a closed line. Raises ``ConfigurationError`` without pyserial."""
    try:
        from trade_drivers.vendors.feetech._wire import Wire  # noqa: PLC0415 - pyserial is optional
    except ImportError as missing:
        raise not_installed("feetech", "pyserial", missing) from None
    return Wire(port, baud, where)
