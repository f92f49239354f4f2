"""Jobs of services for the bus thread, which runs them one exchange at a time between cycles."""

from trade_drivers.bus._gate import Command
from trade_drivers.bus._jobs import Steps
from trade_drivers.joints._axis import AxisT
from trade_drivers.joints._cycle import Exchange


class Enable(Command[AxisT, Exchange[AxisT]]):
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


class Halt(Command[AxisT, Exchange[AxisT]]):
    """Ends any motion of the joints, which then hold. Unlike a stop, it needs a permit and voids none."""

    def steps(self) -> Steps:
        self.gate()
        self.exchange.halt(self.devices, f"{self.service} said so")
        yield
        for axis in self.devices:
            self.exchange.require_answering(axis)


class Relax(Command[AxisT, Exchange[AxisT]]):
    """Switches torque off."""

    def steps(self) -> Steps:
        for axis in self.devices:
            self.exchange.require_answering(axis)
            self.gate()
            self.exchange.end_motion(axis, f"{axis.name} was relaxed")
            yield from self.exchange.relaxing(self, axis)
        self.note("torque off")
