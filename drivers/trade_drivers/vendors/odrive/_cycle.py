"""Commands to ODrives in the cyclic exchange with a bus."""

import logging
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Final

from trade_drivers.bus._cycle import HALT_NS
from trade_drivers.bus.can import Frame
from trade_drivers.joints import Gate, Goal, Steps, Work, next_measurement
from trade_drivers.joints.can._cycle import MotorExchange
from trade_drivers.vendors.odrive import _frames as frames
from trade_drivers.vendors.odrive import _jobs as jobs
from trade_drivers.vendors.odrive._axis import COUNTS_PER_TURN, OdriveAxis
from trade_drivers.vendors.odrive._frames import Command, frame_id
from trade_drivers.vendors.odrive._inspect import look_over

if TYPE_CHECKING:
    from trade_drivers.bus.can import CanPort
    from trade_robotfile import CanBus

_log = logging.getLogger("trade")
_HEALTH: Final = (Command.ERRORS, Command.CURRENTS, Command.TEMPERATURES, Command.SUPPLY)
_BEATS_MISSED_NS: Final = 500_000_000
"""Five heartbeats at an ODrive's default rate."""


class OdriveExchange(MotorExchange[OdriveAxis]):
    """The exchange with the ODrives of one bus.

    The requests in each cycle feed the watchdogs of the axes.
    """

    def __init__(
        self, port: "CanPort", bus: "CanBus", axes: Sequence[OdriveAxis], clock: Callable[[], int] | None = None
    ) -> None:
        super().__init__(port, bus, axes, clock)
        self.deaf_ns = max(_BEATS_MISSED_NS, self.stale_after_ns)
        self.rival = False
        """True if another driver commands these axes."""
        for axis in axes:
            for command, listener in axis.listeners(self.clock).items():
                self.net.hear(frame_id(axis.id, command), listener)
            self._listen_for_rivals(axis)

    def _listen_for_rivals(self, axis: OdriveAxis) -> None:
        """Detects other drivers: their frames feed the watchdogs, which then miss this driver's death."""
        for command in frames.ORDERS:
            self.net.hear(frame_id(axis.id, command), self._hear_rival)
        take = axis.listeners(self.clock)[Command.ESTIMATES]
        self.net.hear(frame_id(axis.id, Command.ESTIMATES), lambda data: take(data) if data else self._hear_rival(data))

    def _hear_rival(self, _: bytes) -> None:
        if not self.rival:
            _log.error("%s: another driver commands the axes of this bus, too", self.port.path)
        self.rival = True

    # --- commands

    def tell(self, axis: OdriveAxis, command: Command, data: bytes) -> None:
        """Sends one frame to an axis; only its heartbeat shows whether it obeys."""
        self.port.send(frame_id(axis.id, command), data)

    def limit(self, axis: OdriveAxis, speed: int, accel: int) -> None:
        """Sets the speed and acceleration of later moves; moves nothing."""
        self.tell(axis, Command.SET_TRAJECTORY_SPEED, frames.set_trajectory_speed(speed / COUNTS_PER_TURN))
        self.tell(axis, Command.SET_TRAJECTORY_ACCEL, frames.set_trajectory_accel(accel / COUNTS_PER_TURN))

    def send_to(self, axis: OdriveAxis, position: int) -> None:
        """Makes the axis move to a position and hold."""
        self.tell(axis, Command.SET_POSITION, frames.set_position(position / COUNTS_PER_TURN))

    def write_goals(self, goals: Mapping[OdriveAxis, Goal], gate: Gate) -> None:
        """Sends the limits, which move nothing; then, after the gate, starts all joints together."""
        for axis, goal in goals.items():
            self.limit(axis, goal.speed, goal.accel)
        self.write_positions({axis: goal.position for axis, goal in goals.items()}, gate)

    def write_positions(self, positions: Mapping[OdriveAxis, int], gate: Gate) -> None:
        commands = [
            Frame(frame_id(axis.id, Command.SET_POSITION), frames.set_position(position / COUNTS_PER_TURN))
            for axis, position in positions.items()
        ]
        gate()
        self.port.send_all(commands)

    def write_holds(self, positions: Mapping[OdriveAxis, int]) -> None:
        """Sends a trajectory to the measured position at full deceleration, only to axes with torque."""
        for axis, position in positions.items():
            if axis.armed and not axis.hushed:
                self.limit(axis, axis.speed_counts, axis.accel_counts)
                self.send_to(axis, position)

    def enabling(self, job: Work[OdriveAxis], axis: OdriveAxis) -> Steps:
        return jobs.enabling(self, job, axis)

    def relaxing(self, job: Work[OdriveAxis], axis: OdriveAxis) -> Steps:
        return jobs.relaxing(self, job, axis)

    def looking(self, axis: OdriveAxis) -> Steps:
        self.require_answering(axis)
        yield from next_measurement(self, axis)

    def leaving(self, job: Work[OdriveAxis], axis: OdriveAxis, *, relax: bool) -> Steps:  # noqa: ARG002 - it can only relax
        return jobs.relaxing(self, job, axis)

    # --- requests

    def question(self, axis: OdriveAxis) -> Frame:
        return Frame(frame_id(axis.id, Command.ESTIMATES), b"")

    def look_over(self, axis: OdriveAxis) -> Steps:
        return look_over(self, axis, first=axis.identity is None)

    def look_after(self, axis: OdriveAxis) -> None:
        """Requests errors, current, temperatures and supply in turn; disarms an axis that does not obey a stop."""
        axis.asked_after = (axis.asked_after + 1) % len(_HEALTH)
        self.tell(axis, _HEALTH[axis.asked_after], b"")
        if axis.halting_since_ns and self.clock() - axis.halting_since_ns > HALT_NS and axis.armed:
            _log.error("%s: a stop was sent, but it is still moving; emergency stop", axis.name)
            self.tell(axis, Command.ESTOP, b"")
