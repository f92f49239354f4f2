"""The driver of a bus of ODrives."""

from typing import TYPE_CHECKING

from trade_drivers.joints.can import CanMotorDriver, axes_of
from trade_drivers.vendors.odrive._axis import MODELS, OdriveAxis
from trade_drivers.vendors.odrive._commission import OdriveCommissioner
from trade_drivers.vendors.odrive._frames import orders
from trade_robotfile import CanBus, Robot

if TYPE_CHECKING:
    from trade_drivers.bus.can import CanPort
    from trade_drivers.vendors.odrive._cycle import OdriveExchange


class OdriveDriver(CanMotorDriver[OdriveAxis, "OdriveExchange"]):
    """ODrives with firmware 0.6 on a CAN bus.

    In a robot file::

        [bus.arm]
        driver = "odrive"
        interface = "socketcan"
        channel = "can0"
        leave = "relax"

        [joint.elbow]
        bus = "arm"
        id = 3
        model = "ODrive S1"
        gear = 8
        zero = "last"
        min_rad = -1.4
        max_rad = 1.4
        max_speed_rad_s = 2.0
        max_accel_rad_s2 = 10.0
    """

    name = "odrive"
    models = MODELS
    commissioner = OdriveCommissioner
    orders = staticmethod(orders)

    def exchange(self, robot: Robot, bus: CanBus, wire: "CanPort", port: str) -> "OdriveExchange":
        from trade_drivers.vendors.odrive._cycle import OdriveExchange  # noqa: PLC0415 - python-can is optional
        from trade_drivers.vendors.odrive._inspect import check_bus  # noqa: PLC0415

        axes = axes_of(OdriveAxis, robot, bus, port)
        check_bus(bus, axes, robot.where)
        return OdriveExchange(wire, bus, axes)
