"""The driver of a bus of Damiao motors."""

from typing import TYPE_CHECKING

from trade_drivers.joints.can import CanMotorDriver, axes_of
from trade_drivers.vendors.damiao._axis import DamiaoAxis
from trade_drivers.vendors.damiao._commission import DamiaoCommissioner
from trade_drivers.vendors.damiao._frames import MODELS, orders
from trade_robotfile import CanBus, Robot

if TYPE_CHECKING:
    from trade_drivers.bus.can import CanPort
    from trade_drivers.vendors.damiao._cycle import DamiaoExchange


class DamiaoDriver(CanMotorDriver[DamiaoAxis, "DamiaoExchange"]):
    """Damiao motors on a CAN bus.

    In a robot file::

        [bus.arm]
        driver = "damiao"
        interface = "socketcan"
        channel = "can0"

        [joint.elbow]
        bus = "arm"
        id = 3
        model = "DM4310"
        min_rad = -1.4
        max_rad = 1.4
        max_speed_rad_s = 2.0
        max_accel_rad_s2 = 10.0
    """

    name = "damiao"
    models = MODELS
    commissioner = DamiaoCommissioner
    orders = staticmethod(orders)

    def exchange(self, robot: Robot, bus: CanBus, wire: "CanPort", port: str) -> "DamiaoExchange":
        from trade_drivers.vendors.damiao._cycle import DamiaoExchange  # noqa: PLC0415 - python-can is optional
        from trade_drivers.vendors.damiao._inspect import check_bus  # noqa: PLC0415

        axes = axes_of(DamiaoAxis, robot, bus, port)
        check_bus(bus, axes, robot.where)
        return DamiaoExchange(wire, bus, axes)
