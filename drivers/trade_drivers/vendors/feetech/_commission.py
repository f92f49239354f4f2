"""Setting Feetech STS servos up."""

from typing import TYPE_CHECKING

from trade_drivers.commissioning._commissioner import Bench, Commissioner
from trade_drivers.joints.serial._commission import ServoBench
from trade_drivers.vendors.feetech import _table as table
from trade_drivers.vendors.feetech._axis import RESOLUTION

if TYPE_CHECKING:
    from trade_drivers.vendors.feetech._wire import Wire  # noqa: F401 - a parameter of the base class

_OPEN, _SHUT = 0, 1


class FeetechCommissioner(Commissioner):
    """STS servos; they leave the factory with id 1 at 1 Mbaud."""

    driver = "feetech"
    bauds = tuple(table.BAUD_CODES)
    ids = range(254)

    def open(self, port: str, baud: int) -> Bench:
        from trade_drivers.vendors.feetech._driver import wire_at  # noqa: PLC0415 - the driver knows us

        wire = wire_at(port, baud, "")
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
