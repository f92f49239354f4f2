"""Commands to Feetech servos in the cyclic exchange with a bus.

They have no watchdog. So each cycle sends a moving joint only a little ahead, and the joint comes to rest by itself
soon after the cycles end, for example when the driver dies or freezes.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Final

from trade.errors import TradeError
from trade_drivers.joints import AxisMotion, Gate, Goal, Steps, Work
from trade_drivers.joints.serial import ServoExchange, health_of
from trade_drivers.vendors.feetech import _jobs as jobs
from trade_drivers.vendors.feetech import _table as table
from trade_drivers.vendors.feetech._axis import CYCLIC, FeetechAxis
from trade_drivers.vendors.feetech._inspect import check_settings

if TYPE_CHECKING:
    from trade_drivers.vendors.feetech._wire import Wire  # noqa: F401 - a parameter of the base class

_SIZES: Final = tuple(register.end - CYCLIC[0] for register in (table.PRESENT_LOAD, table.TEMPERATURE, table.STATUS))


class FeetechExchange(ServoExchange[FeetechAxis, "Wire"]):
    """The exchange with the Feetech servos of one bus."""

    sizes = _SIZES
    answer_overhead = 7

    # --- commands

    def write_goals(self, goals: Mapping[FeetechAxis, Goal], gate: Gate) -> None:
        now_ns = self.clock()
        self._send({axis: axis.step(aim, now_ns) for axis, aim in goals.items()}, gate)
        for axis, aim in goals.items():
            axis.aim = aim

    def write_positions(self, positions: Mapping[FeetechAxis, int], gate: Gate) -> None:
        goals: dict[FeetechAxis, Goal] = {}
        for axis, position in positions.items():
            aim = axis.aim
            accel, speed = (aim.accel, aim.speed) if aim else (axis.accel_counts, axis.speed_counts)
            goals[axis] = Goal(position, accel, speed)
        self.write_goals(goals, gate)

    def write_holds(self, positions: Mapping[FeetechAxis, int]) -> None:
        self._send({axis: axis.brake(position) for axis, position in positions.items()})
        for axis in positions:
            axis.aim = None

    def enabling(self, job: Work[FeetechAxis], axis: FeetechAxis) -> Steps:
        return jobs.enabling(self, job, axis)

    def relaxing(self, job: Work[FeetechAxis], axis: FeetechAxis) -> Steps:
        return jobs.relaxing(self, job, axis)

    def looking(self, axis: FeetechAxis) -> Steps:
        yield from health_of(self, axis)

    def leaving(self, job: Work[FeetechAxis], axis: FeetechAxis, *, relax: bool) -> Steps:
        return jobs.leaving(self, job, axis, relax=relax)

    # --- from the bus thread

    def check_settings(self, axis: FeetechAxis, settings: bytes, key: str) -> None:
        check_settings(axis, settings, key)

    def name_of(self, model_number: int) -> str:
        return table.name_of(model_number, str(model_number))

    def admit(self, axis: FeetechAxis) -> None:
        self.stop_found_moving(axis)

    def look_after(self, axis: FeetechAxis) -> None:
        """Switches off a servo stopped by its own protection, as it would continue once the cause is gone."""
        if axis.health is not None and axis.health.torque and axis.health.error & axis.unload:
            self.wire.write(axis.id, table.TORQUE.address, table.TORQUE.encode(0))
            axis.take_health(self.wire.read(axis.id, *axis.slow).data, self.clock())

    def watch(self) -> None:
        super().watch()
        self._lead_on()

    def _lead_on(self) -> None:
        """Sends moving joints their next goals, at most the allowed distance ahead of their measurements."""
        steps: dict[FeetechAxis, Goal] = {}
        now_ns = self.clock()
        for motion in dict.fromkeys(axis.motion for axis in self.devices if axis.motion is not None):
            try:
                if due := _due(motion, now_ns):
                    motion.permit.gate()
                    steps.update(due)
            except TradeError as ending:
                self.release(motion, ending)
        if steps:
            self._send(steps)

    def _send(self, goals: Mapping[FeetechAxis, Goal], gate: Gate | None = None) -> None:
        data = {axis.id: jobs.goal_block(goal) for axis, goal in goals.items()}
        self.wire.sync_write(jobs.GOAL_BLOCK[0], data, gate)
        sent_ns = self.clock()
        for axis, goal in goals.items():
            axis.sent, axis.sent_ns = goal.position, sent_ns


def _due(motion: AxisMotion[FeetechAxis], now_ns: int) -> dict[FeetechAxis, Goal]:
    """Returns the next goals of a motion's joints, where they differ from the last ones."""
    due: dict[FeetechAxis, Goal] = {}
    for axis in motion.devices:
        if axis.aim is None or axis.in_doubt:
            continue
        if (step := axis.step(axis.aim, now_ns)).position != axis.sent:
            due[axis] = step
    return due
