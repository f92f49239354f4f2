"""Setting Feetech STS servos up."""

from trade_drivers.commissioning._commissioner import Bench, Commissioner
from trade_drivers.joints.serial._commission import ServoBench
from trade_drivers.vendors.feetech import _table as table

__all__ = ["FeetechCommissioner"]

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


class FeetechBench(ServoBench):
    """An open line of them."""

    driver = "feetech"
    restless = (table.PRESENT_POSITION.address, table.MOVING.end - table.PRESENT_POSITION.address)
    mute = "it tells its model and nothing else; check its cable"

    def model_of(self, number: int) -> str:
        return table.name_of(number, "")

    def firmware_of(self, device_id: int) -> str:
        return table.firmware(self.wire.read(device_id, table.MAJOR.address, table.MINOR.end).data)

    def torque_of(self, device_id: int) -> bool:
        return self._read(device_id, table.TORQUE) != 0

    def angle_rad(self, device_id: int) -> float:
        return (self._read(device_id, table.PRESENT_POSITION) - table.CENTRE_COUNTS) * table.RAD_PER_COUNT

    def homing_counts(self, device_id: int) -> int:
        return self._read(device_id, table.HOMING_OFFSET)

    def write_id(self, device_id: int, to: int) -> None:
        self._opened(device_id, table.ID, to)

    def write_baud(self, device_id: int, to: int) -> None:
        self._opened(device_id, table.BAUD, table.BAUD_CODES[to])

    def seal(self, device_id: int) -> None:
        self.told(device_id, table.LOCK.address, table.LOCK.encode(_SHUT))

    def _opened(self, device_id: int, register: table.Register, value: int) -> None:
        """A write that outlives the power."""
        self.told(device_id, table.LOCK.address, table.LOCK.encode(_OPEN))
        self.told(device_id, register.address, register.encode(value))

    def _read(self, device_id: int, register: table.Register) -> int:
        return register.decode(self.wire.read(device_id, register.address, register.size).data, register.address)
