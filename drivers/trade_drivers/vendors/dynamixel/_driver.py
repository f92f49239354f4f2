"""The driver of a Dynamixel bus, and the setting up of its servos."""

import logging
from typing import TYPE_CHECKING, Final

from trade.errors import ConfigurationError
from trade_drivers._validation import not_installed
from trade_drivers.commissioning._commissioner import Bench, Commissioner
from trade_drivers.joints import check_joints
from trade_drivers.joints.serial import (
    NoAnswer,
    PersistentRegisters,
    ServoBench,
    ServoDriver,
    ServoExchange,
    check_cycle,
    check_ranges,
)
from trade_drivers.vendors.dynamixel import _table as table
from trade_drivers.vendors.dynamixel._axis import CYCLIC, RESOLUTION, DynamixelAxis
from trade_drivers.vendors.dynamixel._exchange import DynamixelExchange
from trade_robotfile import Joint, Robot, SerialBus

if TYPE_CHECKING:
    from trade_drivers.vendors.dynamixel._wire import Wire

_log = logging.getLogger("trade")
_SLOW_ANSWER_S: Final = 100e-6


class DynamixelCommissioner(Commissioner):
    """X-series servos; they leave the factory with id 1 at 57600 baud."""

    driver = "dynamixel"
    bauds = (57_600, 1_000_000, 115_200, 2_000_000, 3_000_000, 4_000_000, 9_600)
    ids = range(253)

    def open(self, port: str, baud: int) -> Bench:
        wire = _wire_at(port, baud, "")
        wire.open()
        return DynamixelBench(wire, baud)


class DynamixelBench(ServoBench["Wire"]):
    """An open line of Dynamixel servos."""

    driver = "dynamixel"
    restless = (table.REALTIME_TICK.address, table.INPUT_VOLTAGE.end - table.REALTIME_TICK.address)
    mute = "it answers a ping but no read: its status return level (register 68) is 0; set it to 2 by the vendor's tool"
    resolution = RESOLUTION
    torque, position, homing = table.TORQUE_ENABLE, table.PRESENT_POSITION, table.HOMING_OFFSET

    def anybody(self) -> bool:
        return self.wire.anybody()

    def model_of(self, number: int) -> str:
        return table.name_of(number, "")

    def firmware_of(self, device_id: int) -> str:
        return str(self.read(device_id, table.FIRMWARE))

    def write_id(self, device_id: int, to: int) -> None:
        self.write(device_id, table.ID, to)

    def write_baud(self, device_id: int, to: int) -> None:
        self.write(device_id, table.BAUD, table.BAUD_CODES[to])

    def seal(self, device_id: int) -> None:
        """Does nothing, as the EEPROM is writable whenever torque is off."""


class DynamixelDriver(ServoDriver[DynamixelAxis, "Wire"]):
    """X-series servos in position control on a serial bus, through dynamixel-sdk.

    In a robot file::

        [bus.arm]
        driver = "dynamixel"
        port = "/dev/serial/by-id/usb-1a86_USB_Single_Serial_58FA083324-if00"
        baud = 1_000_000

        [joint.elbow]
        bus = "arm"
        id = 3
        model = "XL430-W250"
        min_rad = -1.4
        max_rad = 1.4
        max_speed_rad_s = 2.5
        max_accel_rad_s2 = 20.0
    """

    name = "dynamixel"
    models = table.BY_MODEL_NAME
    bauds = table.BAUD_CODES
    kept = PersistentRegisters((table.ID.address, table.BAUD.address), table.name_of, table.firmware)
    modules = ("dynamixel_sdk", "serial")
    commissioner = DynamixelCommissioner

    def exchange(self, robot: Robot, bus: SerialBus, port: str, joints: list[Joint]) -> DynamixelExchange:
        axes = [
            DynamixelAxis(f"{robot.name}.{joint.name}", port, joint, robot.coupled_to(joint.name)) for joint in joints
        ]
        check_joints(axes, robot.where, check_ranges)
        _check_cycle(bus, len(axes), robot.where)
        wire = _wire_at(port, bus.baud, f"{robot.where}: bus.{bus.name}", fast=bus.fast_sync)
        return DynamixelExchange(wire, bus, axes)

    def verify(
        self,
        exchange: ServoExchange[DynamixelAxis, "Wire"],
        wire: "Wire",
        bus: SerialBus,
        axis: DynamixelAxis,
        where: str,
    ) -> bytes:
        try:
            settings = super().verify(exchange, wire, bus, axis, where)
        except NoAnswer:
            silent = "it answers a ping but no read: its status return level (68) is 0 or 1; set it to 2"
            raise ConfigurationError(where=f'{where}: joint."{axis.joint.name}"', problem=silent) from None
        delay_s = table.RETURN_DELAY.decode(settings) * table.RETURN_DELAY.si_per_count
        if delay_s > _SLOW_ANSWER_S:
            _log.info("%s waits %.0f us before it answers (register 9); 0 is faster", axis.name, delay_s * 1e6)
        return settings


def _check_cycle(bus: SerialBus, count: int, where: str) -> None:
    read = 14 + count + (8 + count * 14 if bus.fast_sync else count * (11 + CYCLIC[1]))
    check_cycle(bus, count, read + 14 + count * 5, where)


def _wire_at(port: str, baud: int, where: str, *, fast: bool = False) -> "Wire":
    """Returns a closed line. Raises ``ConfigurationError`` without the vendor library."""
    try:
        from trade_drivers.vendors.dynamixel._wire import Wire  # noqa: PLC0415 - the vendor library is optional
    except ImportError as missing:
        raise not_installed("dynamixel", "dynamixel-sdk", missing) from None
    return Wire(port, baud, where, fast=fast)
