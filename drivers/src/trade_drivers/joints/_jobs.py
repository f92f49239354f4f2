"""What services ask of the bus thread: work of several exchanges, done one exchange at a time between the cycles."""

from collections.abc import Sequence
from enum import Enum
from typing import TYPE_CHECKING

from trade import Permit
from trade.errors import TradeError
from trade_drivers.bus._jobs import Steps, Work, check_admitted
from trade_drivers.joints._axis import Axis

if TYPE_CHECKING:
    from trade_drivers.joints._cycle import Exchange

__all__ = ["Command", "Enable", "Halt", "Job", "Leave", "Manner", "Relax", "Steps"]


class Manner(Enum):
    """What a job is going to tell its joints, for devices that have a mode for each."""

    GOALS = "goals"
    """Where to go, now and then."""
    POSITIONS = "positions"
    """Where to be, in every cycle."""
    SPEEDS = "speeds"
    """How fast to turn, and where to end at the latest."""


class Job(Work[Axis]):
    """Something that is waited for. As it stands it needs no leave: it ends motion."""

    manner = Manner.GOALS

    def __init__(self, exchange: "Exchange", axes: Sequence[Axis]) -> None:
        super().__init__(axes)
        self.exchange = exchange
        self.axes = tuple(axes)


class Command(Job):
    """What may set something moving: it carries an expiry, and the permit under which its call was admitted."""

    def __init__(
        self, exchange: "Exchange", axes: Sequence[Axis], *, service: str, expires_ns: int, permit: Permit
    ) -> None:
        super().__init__(exchange, axes)
        self.service = service
        self.expires_ns = expires_ns
        self.permit = permit
        self._admitted_ns = exchange.clock()

    def gate(self) -> None:
        """The last look before its bytes go out.

        Raises:
            DeadlineExceeded: it is late, and late is never.
            MotionStopped, LockLost, LockedByOther: a stop, or another owner, came after it was admitted.
        """
        now_ns = self.exchange.clock()
        check_admitted(
            self.service, self.permit, admitted_ns=self._admitted_ns, expires_ns=self.expires_ns, now_ns=now_ns
        )


class Enable(Command):
    """Torque on, holding where the joints are. A joint that is enabled already is only looked at, not disturbed."""

    def steps(self) -> Steps:
        for axis in self.axes:
            if axis.ready:
                yield from self.exchange.looking(axis)
            if not axis.ready:
                yield from self.exchange.enabling(self, axis)
        self.note("torque on, read back")


class Halt(Command):
    """Whatever moves the joints ends, and they hold; unlike a stop it needs leave and makes nothing void."""

    def steps(self) -> Steps:
        self.gate()
        self.exchange.halt(self.axes, f"{self.service} said so")
        yield
        for axis in self.axes:
            self.exchange.require_answering(axis)


class Relax(Command):
    """Torque off."""

    def steps(self) -> Steps:
        for axis in self.axes:
            self.exchange.require_answering(axis)
            self.gate()
            self.exchange.end_motion(axis, f"{axis.name} was relaxed")
            yield from self.exchange.relaxing(self, axis)
        self.note("torque off")


class Leave(Job):
    """The driver goes, after it has stopped everything: hold or relax, as the robot file says.

    A joint that holds is disarmed once it was seen at rest: silence on the bus is then what is wanted, and an expired
    watchdog would only hinder whoever comes next. Not seen at rest, or silent: its watchdog stays armed.
    """

    def __init__(self, exchange: "Exchange", axes: Sequence[Axis], *, relax: bool) -> None:
        super().__init__(exchange, axes)
        self._relax = relax

    def steps(self) -> Steps:
        for axis in self.axes:
            if axis.silent:
                continue
            try:
                yield from self.exchange.leaving(self, axis, relax=self._relax)
            except TradeError as problem:
                self.finish(problem)
