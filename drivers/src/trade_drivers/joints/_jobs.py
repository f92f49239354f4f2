"""What services ask of the bus thread: work of several exchanges, done one exchange at a time between the cycles."""

from collections.abc import Sequence
from enum import Enum
from typing import TYPE_CHECKING

from trade.errors import TradeError
from trade_drivers.bus._jobs import Command, Steps, Work
from trade_drivers.joints._axis import AxisT

if TYPE_CHECKING:
    from trade_drivers.joints._cycle import Exchange

__all__ = ["Enable", "Halt", "Leave", "Manner", "Relax"]


class Manner(Enum):
    """What a motion is going to tell its joints, for devices that have a mode for each."""

    GOALS = "goals"
    """Where to go, now and then."""
    POSITIONS = "positions"
    """Where to be, in every cycle."""
    SPEEDS = "speeds"
    """How fast to turn, and where to end at the latest."""


class Enable(Command[AxisT, "Exchange[AxisT]"]):
    """Torque on, holding where the joints are. A joint that is enabled already is only looked at, not disturbed."""

    def steps(self) -> Steps:
        for axis in self.devices:
            if axis.ready:
                yield from self.exchange.looking(axis)
            if not axis.ready:
                yield from self.exchange.enabling(self, axis)
        self.note("torque on, read back")


class Halt(Command[AxisT, "Exchange[AxisT]"]):
    """Whatever moves the joints ends, and they hold; unlike a stop it needs leave and makes nothing void."""

    def steps(self) -> Steps:
        self.gate()
        self.exchange.halt(self.devices, f"{self.service} said so")
        yield
        for axis in self.devices:
            self.exchange.require_answering(axis)


class Relax(Command[AxisT, "Exchange[AxisT]"]):
    """Torque off."""

    def steps(self) -> Steps:
        for axis in self.devices:
            self.exchange.require_answering(axis)
            self.gate()
            self.exchange.end_motion(axis, f"{axis.name} was relaxed")
            yield from self.exchange.relaxing(self, axis)
        self.note("torque off")


class Leave(Work[AxisT]):
    """The driver goes, after it has stopped everything: hold or relax, as the robot file says.

    A joint that holds is disarmed once it was seen at rest: silence on the bus is then what is wanted, and an expired
    watchdog would only hinder whoever comes next. Not seen at rest, or silent: its watchdog stays armed.
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
            except TradeError as problem:
                self.finish(problem)
