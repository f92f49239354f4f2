"""Jobs of services for the bus thread, which runs them one exchange at a time between cycles."""

from collections.abc import Sequence
from enum import Enum
from typing import TYPE_CHECKING

from trade.errors import DeviceSilent, TradeError
from trade_drivers.bus._gate import Command
from trade_drivers.bus._jobs import Steps, Work
from trade_drivers.joints._axis import AxisT

if TYPE_CHECKING:
    from trade_drivers.joints._cycle import Exchange


class ControlMode(Enum):
    """The kind of a motion's commands, for devices with a mode for each."""

    GOALS = "goals"
    """A goal to move to."""
    POSITIONS = "positions"
    """A position in each cycle."""
    SPEEDS = "speeds"
    """A velocity, and the position where it must end."""


class Enable(Command[AxisT, "Exchange[AxisT]"]):
    """Switches torque on at the measured positions. A joint that is already enabled is only checked."""

    def steps(self) -> Steps:
        for axis in self.devices:
            axis.check_zero()
        for axis in self.devices:
            if axis.ready:
                yield from self.exchange.looking(axis)
            if not axis.ready:
                yield from self.exchange.enabling(self, axis)
        self.note("torque on, read back")


class Halt(Command[AxisT, "Exchange[AxisT]"]):
    """Ends any motion of the joints, which then hold. Unlike a stop, it needs a permit and voids none."""

    def steps(self) -> Steps:
        self.gate()
        self.exchange.halt(self.devices, f"{self.service} said so")
        yield
        for axis in self.devices:
            self.exchange.require_answering(axis)


class Relax(Command[AxisT, "Exchange[AxisT]"]):
    """Switches torque off."""

    def steps(self) -> Steps:
        for axis in self.devices:
            self.exchange.require_answering(axis)
            self.gate()
            self.exchange.end_motion(axis, f"{axis.name} was relaxed")
            yield from self.exchange.relaxing(self, axis)
        self.note("torque off")


class Leave(Work[AxisT]):
    """The shutdown of the driver after all joints were stopped: hold or relax, as the robot file says.

    The watchdog of a holding joint is disarmed after the joint was seen at rest, since the driver's silence is then
    intended and an expired watchdog would hinder the next driver. Otherwise it stays armed.
    """

    def __init__(self, exchange: "Exchange[AxisT]", axes: Sequence[AxisT], *, relax: bool) -> None:
        super().__init__(axes)
        self._exchange = exchange
        self._relax = relax

    def steps(self) -> Steps:
        for axis in self.devices:
            if axis.silent:
                continue
            try:
                yield from self._exchange.leaving(self, axis, relax=self._relax)
            except DeviceSilent:
                continue  # like a joint that was silent before: ``unseen()`` reports it
            except TradeError as problem:
                self.finish(problem)
