"""Bringing a bus of ODrives up."""

from collections.abc import Collection
from typing import TYPE_CHECKING, Any

from trade_drivers.joints.can import CanMotorDriver
from trade_drivers.robotfile import CanBus, Robot
from trade_drivers.vendors.odrive._axis import MODELS, OdriveAxis
from trade_drivers.vendors.odrive._commission import OdriveCommissioner
from trade_drivers.vendors.odrive._frames import orders

if TYPE_CHECKING:
    from trade_drivers.bus.can import CanPort, Talk
    from trade_drivers.joints.can._cycle import MotorExchange
    from trade_drivers.vendors.odrive._cycle import OdriveExchange

__all__ = ["OdriveDriver", "open_exchange"]


class OdriveDriver(CanMotorDriver):
    """ODrives with firmware 0.6 on a CAN bus."""

    name = "odrive"
    models = MODELS
    commissioner = OdriveCommissioner

    def exchange(self, robot: Robot, bus: CanBus, wire: "CanPort", port: str) -> "OdriveExchange":
        from trade_drivers.vendors.odrive._cycle import OdriveExchange  # noqa: PLC0415
        from trade_drivers.vendors.odrive._inspect import check_bus  # noqa: PLC0415 - python-can is optional

        axes = [
            OdriveAxis(f"{robot.name}.{joint.name}", port, joint, bus.rate_hz, robot.coupled_to(joint.name))
            for joint in robot.joints_on(bus.name)
        ]
        check_bus(bus, axes, robot.where)
        return OdriveExchange(wire, bus, axes)

    def orders(self, talk: "Talk", nodes: Collection[int]) -> Collection[int]:
        return orders(talk, nodes)


def open_exchange(robot: Robot, bus: CanBus, port: str) -> "MotorExchange[Any]":
    """Open the port and look every axis over, without a thread: ``cycle()`` is the caller's to call.

    Raises:
        ConfigurationError: the port cannot be had, or an axis is absent, another, or cannot be used as it is.
    """
    return OdriveDriver().open_exchange(robot, bus, port)
