"""Bringing a bus of ODrives up."""

from typing import TYPE_CHECKING, Any, cast

from trade.errors import ConfigurationError
from trade_drivers.canmotors import CanMotorDriver
from trade_drivers.odrive._axis import MODELS, OdriveAxis
from trade_drivers.odrive._commission import OdriveCommissioner
from trade_drivers.robotfile import CanBus, Robot

if TYPE_CHECKING:
    from trade_drivers.can import CanPort
    from trade_drivers.canmotors._exchange import MotorExchange
    from trade_drivers.odrive._exchange import OdriveExchange

__all__ = ["OdriveDriver", "open_exchange"]


class OdriveDriver(CanMotorDriver):
    """ODrives with firmware 0.6 on a CAN bus."""

    name = "odrive"
    commissioner = OdriveCommissioner

    def exchange(self, robot: Robot, bus: CanBus, wire: "CanPort", port: str) -> "OdriveExchange":
        from trade_drivers.odrive._attach import check_bus  # noqa: PLC0415 - python-can is optional
        from trade_drivers.odrive._exchange import OdriveExchange  # noqa: PLC0415

        joints = robot.joints_on(bus.name)
        for joint in joints:
            if joint.model not in MODELS:
                problem = f"{joint.model!r} is none of {', '.join(MODELS)}"
                raise ConfigurationError(where=f'{robot.where}: joint."{joint.name}".model', problem=problem)
        axes = [
            OdriveAxis(f"{robot.name}.{joint.name}", port, joint, bus.rate_hz, robot.coupled_to(joint.name))
            for joint in joints
        ]
        check_bus(bus, axes, robot.where)
        return OdriveExchange(wire, bus, axes)

    def listen(self, exchange: "MotorExchange[Any]", bus: CanBus, where: str) -> None:
        """For as long as the watchdogs take: then only what is fed by somebody else, or is not watched, has torque."""
        listen_s = bus.watchdog_s + 0.1
        for axis in exchange.motors:
            axis.probe_at_ns = exchange.clock() + int(listen_s * 1e9)
        exchange.net.take_in(listen_s)
        if cast("OdriveExchange", exchange).rival:
            problem = f"{exchange.port.path}: another driver commands the axes of this bus already; stop it first"
            raise ConfigurationError(where=f"{where}.channel", problem=problem)


def open_exchange(robot: Robot, bus: CanBus, port: str) -> "MotorExchange[Any]":
    """Open the port and look every axis over, without a thread: ``cycle()`` is the caller's to call.

    Raises:
        ConfigurationError: the port cannot be had, or an axis is absent, another, or cannot be used as it is.
    """
    return OdriveDriver().open_exchange(robot, bus, port)
