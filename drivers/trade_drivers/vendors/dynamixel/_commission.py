"""Setting Dynamixel X-series servos up."""

from typing import TYPE_CHECKING

from trade_drivers.commissioning._commissioner import Bench, Commissioner
from trade_drivers.joints.serial._commission import ServoBench
from trade_drivers.vendors.dynamixel import _table as table
from trade_drivers.vendors.dynamixel._axis import RESOLUTION

if TYPE_CHECKING:
    from trade_drivers.vendors.dynamixel._wire import Wire  # noqa: F401 - a parameter of the base class


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
