"""Scanning a line for 2F-85 grippers, whose ids and rates only the vendor's tool can set."""

from typing import TYPE_CHECKING, NoReturn

from trade.errors import ConfigurationError
from trade_drivers.bus._jobs import NoAnswer, Refused
from trade_drivers.commissioning._commissioner import Bench, Commissioner, Found
from trade_drivers.vendors.robotiq import _table as table

if TYPE_CHECKING:
    from trade_drivers.vendors.robotiq._wire import Wire


class RobotiqCommissioner(Commissioner):
    """2F-85 grippers; they leave the factory with id 9 at 115200 baud."""

    driver = "robotiq"
    bauds = (115_200,)
    ids = range(1, 248)

    def open(self, port: str, baud: int) -> Bench:
        from trade_drivers.vendors.robotiq._driver import wire_at  # noqa: PLC0415 - the driver knows us

        wire = wire_at(port, baud, "")
        wire.open()
        return RobotiqBench(wire, port, baud)


class RobotiqBench(Bench):
    """An open line of 2F-85 grippers."""

    def __init__(self, wire: "Wire", port: str, baud: int) -> None:
        self._wire, self._port, self._baud = wire, port, baud

    def anybody(self) -> bool:
        return True

    def look(self, device_id: int) -> Found | None:
        try:
            status = table.Status.decode(self._wire.read(device_id), 0)
        except NoAnswer:
            self._wire.settled_at = 0.0  # a late answer must not be taken for that of the next id
            return None
        except Refused:
            return self._found(device_id, "", "it is a Modbus device, but no 2F-85")
        if not status.plausible:
            return self._found(device_id, "", "it has the registers of a 2F-85, but what they read makes no sense")
        return self._found(device_id, "2F-85", "")

    def _found(self, device_id: int, model: str, problem: str) -> Found:
        return Found(driver="robotiq", kind="gripper", baud=self._baud, id=device_id, model=model, problem=problem)

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
