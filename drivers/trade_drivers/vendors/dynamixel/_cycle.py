"""Commands to Dynamixel servos in the cyclic exchange with a bus."""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Final

from trade_drivers.joints import Gate, Goal, Steps, Work
from trade_drivers.joints.serial import ServoExchange, health_of
from trade_drivers.vendors.dynamixel import _jobs as jobs
from trade_drivers.vendors.dynamixel import _table as table
from trade_drivers.vendors.dynamixel._axis import CYCLIC, DynamixelAxis
from trade_drivers.vendors.dynamixel._inspect import check_settings

if TYPE_CHECKING:
    from trade_drivers.vendors.dynamixel._wire import Wire
    from trade_robotfile import SerialBus

_SIZES: Final = tuple(
    register.end - CYCLIC[0]
    for register in (table.PRESENT_POSITION, table.VELOCITY_TRAJECTORY, table.POSITION_TRAJECTORY)
)


class DynamixelExchange(ServoExchange[DynamixelAxis, "Wire"]):
    """The exchange with the Dynamixel servos of one bus."""

    sizes = _SIZES
    answer_overhead = 12

    def __init__(
        self,
        wire: "Wire",
        bus: "SerialBus",
        axes: Sequence[DynamixelAxis],
        clock: Callable[[], int] | None = None,
    ) -> None:
        super().__init__(wire, bus, axes, clock)
        self.watchdog_counts = max(1, min(127, round(bus.watchdog_s / table.BUS_WATCHDOG.si_per_count)))

    def write_goals(self, goals: Mapping[DynamixelAxis, Goal], gate: Gate) -> None:
        data = {axis.id: jobs.goal_block(goal) for axis, goal in goals.items()}
        self.wire.sync_write(table.PROFILE_ACCELERATION.address, data, gate)

    def write_positions(self, positions: Mapping[DynamixelAxis, int], gate: Gate) -> None:
        data = {axis.id: table.GOAL_POSITION.encode(position) for axis, position in positions.items()}
        self.wire.sync_write(table.GOAL_POSITION.address, data, gate)

    def write_holds(self, positions: Mapping[DynamixelAxis, int]) -> None:
        ready: dict[int, bytes] = {}
        others: dict[int, bytes] = {}
        for axis, position in positions.items():
            if axis.ready or axis.outside(position):
                ready[axis.id] = jobs.goal_block(axis.brake(position))
            else:
                others[axis.id] = table.GOAL_POSITION.encode(axis.own_goal(position))
        if ready:
            self.wire.sync_write(table.PROFILE_ACCELERATION.address, ready)
        if others:
            self.wire.sync_write(table.GOAL_POSITION.address, others)

    def enabling(self, job: Work[DynamixelAxis], axis: DynamixelAxis) -> Steps:
        return jobs.enabling(self, job, axis)

    def relaxing(self, job: Work[DynamixelAxis], axis: DynamixelAxis) -> Steps:
        return jobs.relaxing(self, job, axis)

    def looking(self, axis: DynamixelAxis) -> Steps:
        yield from health_of(self, axis)

    def leaving(self, job: Work[DynamixelAxis], axis: DynamixelAxis, *, relax: bool) -> Steps:
        return jobs.leaving(self, job, axis, relax=relax)

    def check_settings(self, axis: DynamixelAxis, settings: bytes, key: str) -> None:
        check_settings(axis, settings, key)

    def name_of(self, model_number: int) -> str:
        return table.name_of(model_number, str(model_number))

    def admit(self, axis: DynamixelAxis) -> None:
        """Arms the watchdog of a joint that is already enabled, and stops one that moves."""
        health = axis.health
        if health is None or not health.torque or health.watchdog == table.WATCHDOG_EXPIRED:
            return
        self.wire.write(axis.id, table.BUS_WATCHDOG.address, table.BUS_WATCHDOG.encode(self.watchdog_counts))
        self.stop_found_moving(axis)
