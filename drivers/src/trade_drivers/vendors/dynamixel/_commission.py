"""Setting Dynamixel X-series servos up."""

from typing import TYPE_CHECKING, cast

from trade_drivers.commissioning._commissioner import Bench, Commissioner
from trade_drivers.joints.serial._commission import ServoBench
from trade_drivers.vendors.dynamixel import _table as table

if TYPE_CHECKING:
    from trade_drivers.vendors.dynamixel._sdk import Wire

__all__ = ["DynamixelCommissioner"]


class DynamixelCommissioner(Commissioner):
    """X-series servos; they leave the factory with id 1 at 57600 baud."""

    driver = "dynamixel"
    bauds = (57_600, 1_000_000, 115_200, 2_000_000, 3_000_000, 4_000_000, 9_600)
    ids = range(253)

    def open(self, port: str, baud: int) -> Bench:
        from trade_drivers.vendors.dynamixel._driver import wire_at  # noqa: PLC0415 - the driver knows us

        wire = wire_at(port, baud, "")
        wire.open()
        return DynamixelBench(wire, baud)


class DynamixelBench(ServoBench):
    """An open line of them."""

    driver = "dynamixel"
    restless = (table.REALTIME_TICK.address, table.INPUT_VOLTAGE.end - table.REALTIME_TICK.address)
    mute = "it answers a ping but no read: its status return level (register 68) is 0; set it to 2 by the vendor's tool"

    def anybody(self) -> bool:
        return cast("Wire", self.wire).anybody()

    def model_of(self, number: int) -> str:
        return table.name_of(number, "")

    def firmware_of(self, device_id: int) -> str:
        return str(self._read(device_id, table.FIRMWARE))

    def torque_of(self, device_id: int) -> bool:
        return self._read(device_id, table.TORQUE_ENABLE) != 0

    def angle_rad(self, device_id: int) -> float:
        return (self._read(device_id, table.PRESENT_POSITION) - table.CENTRE_COUNTS) * table.RAD_PER_COUNT

    def homing_counts(self, device_id: int) -> int:
        return self._read(device_id, table.HOMING_OFFSET)

    def write_id(self, device_id: int, to: int) -> None:
        self.told(device_id, table.ID.address, table.ID.encode(to))

    def write_baud(self, device_id: int, to: int) -> None:
        self.told(device_id, table.BAUD.address, table.BAUD.encode(table.BAUD_CODES[to]))

    def seal(self, device_id: int) -> None:
        """Its EEPROM is open whenever its torque is off."""

    def _read(self, device_id: int, register: table.Register) -> int:
        return register.decode(self.wire.read(device_id, register.address, register.size).data, register.address)
