"""The driver of a bus of CiA 402 drives."""

from typing import TYPE_CHECKING, Any, Final

from trade.errors import ConfigurationError
from trade_drivers.joints import BusMotor
from trade_drivers.joints.can import CanMotorCommissioner, CanMotorDriver
from trade_drivers.vendors.cia402._table import orders

if TYPE_CHECKING:
    from trade_drivers.commissioning._can_scan import CanBench
    from trade_drivers.vendors.cia402._axis import DriveAxis
    from trade_drivers.vendors.cia402._exchange import DriveExchange

_FIRST_CYCLES: Final = 3
"""The number of measurements needed to detect motion."""


class Cia402Commissioner(CanMotorCommissioner):
    """CiA 402 drives on a CAN bus, given as ``INTERFACE:CHANNEL``."""

    driver = "cia402"
    libraries = "canopen and python-can"
    ids = range(1, 127)

    def bench(self) -> "type[CanBench]":
        from trade_drivers.vendors.cia402._scan import DriveBench  # noqa: PLC0415 - the libraries are optional

        return DriveBench


class Cia402Driver(CanMotorDriver["DriveAxis", "DriveExchange"]):
    """Drives in profile position mode on a CAN bus, through python-can and canopen.

    In a robot file::

        [bus.arm]
        driver = "cia402"
        interface = "socketcan"
        channel = "can0"

        [joint.elbow]
        bus = "arm"
        id = 3
        model = "ACME-EC60"
        counts_per_rev = 4096
        gear = 50
        min_rad = -1.4
        max_rad = 1.4
        max_speed_rad_s = 2.0
        max_accel_rad_s2 = 10.0
    """

    name = "cia402"
    models = ()
    modules = ("can", "canopen")
    libraries = "canopen and python-can"
    commissioner = Cia402Commissioner
    orders = staticmethod(orders)

    def exchange_type(self) -> "type[DriveExchange]":
        from trade_drivers.vendors.cia402._exchange import DriveExchange  # noqa: PLC0415 - the libraries are optional

        return DriveExchange

    def motor(self) -> type[BusMotor[Any, Any]]:
        from trade_drivers.vendors.cia402._homing import Drive  # noqa: PLC0415 - the libraries are optional

        return Drive

    def first_look(self, exchange: "DriveExchange") -> None:
        for _ in range(_FIRST_CYCLES):
            exchange.cycle()

    def check_away(self, exchange: "DriveExchange", axis: "DriveAxis", where: str, *, last: bool) -> None:
        from trade_drivers.vendors.cia402._axis import Stage  # noqa: PLC0415
        from trade_drivers.vendors.cia402._wire import DriveRefused, NoAnswer  # noqa: PLC0415 - the libraries are optional

        key = f'{where}: joint."{axis.joint.name}"'
        match exchange.problems.get(axis):
            case DriveRefused() as refused:
                raise ConfigurationError(where=key, problem=f"it refuses to be read: {refused}")
            case NoAnswer() as silent if last and axis.stage is Stage.AWAY:
                problem = (
                    f"no drive answers as node {axis.id} on {axis.bus} ({silent}); check its power and cable, its node "
                    "id and bit rate, and the two terminations of the bus"
                )
                raise self.absent(exchange, key, problem)
            case _:
                super().check_away(exchange, axis, where, last=last)
        exchange.recall(axis)
