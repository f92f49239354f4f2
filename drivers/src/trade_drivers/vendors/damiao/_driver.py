"""Bringing a bus of Damiao motors up."""

from collections.abc import Collection
from typing import TYPE_CHECKING, Any

from trade_drivers.joints.can import CanMotorDriver
from trade_drivers.robotfile import CanBus, Robot
from trade_drivers.vendors.damiao._axis import DamiaoAxis
from trade_drivers.vendors.damiao._commission import DamiaoCommissioner
from trade_drivers.vendors.damiao._frames import MODELS, orders

if TYPE_CHECKING:
    from trade_drivers.bus.can import CanPort, Talk
    from trade_drivers.joints.can._cycle import MotorExchange
    from trade_drivers.vendors.damiao._cycle import DamiaoExchange

__all__ = ["DamiaoDriver", "open_exchange"]


class DamiaoDriver(CanMotorDriver):
    """Damiao motors on a CAN bus."""

    name = "damiao"
    models = MODELS
    commissioner = DamiaoCommissioner

    def exchange(self, robot: Robot, bus: CanBus, wire: "CanPort", port: str) -> "DamiaoExchange":
        from trade_drivers.vendors.damiao._cycle import DamiaoExchange  # noqa: PLC0415
        from trade_drivers.vendors.damiao._inspect import check_bus  # noqa: PLC0415 - python-can is optional

        axes = [
            DamiaoAxis(f"{robot.name}.{joint.name}", port, joint, bus.rate_hz, robot.coupled_to(joint.name))
            for joint in robot.joints_on(bus.name)
        ]
        check_bus(bus, axes, robot.where)
        return DamiaoExchange(wire, bus, axes)

    def orders(self, talk: "Talk", nodes: Collection[int]) -> Collection[int]:
        return orders(talk, nodes)


def open_exchange(robot: Robot, bus: CanBus, port: str) -> "MotorExchange[Any]":
    """Open the port and look every motor over, without a thread: ``cycle()`` is the caller's to call.

    Raises:
        ConfigurationError: the port cannot be had, or a motor is absent, another, or cannot be used as it is.
    """
    return DamiaoDriver().open_exchange(robot, bus, port)
