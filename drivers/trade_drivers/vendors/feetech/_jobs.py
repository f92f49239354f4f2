"""The steps of enabling, relaxing and leaving a servo: one exchange after the other."""

from typing import TYPE_CHECKING, Final

from trade_drivers.joints import Goal, Steps, Work
from trade_drivers.joints.serial import as_set, health_of, tried, written
from trade_drivers.vendors.feetech import _table as table
from trade_drivers.vendors.feetech._axis import FeetechAxis

if TYPE_CHECKING:
    from trade_drivers.vendors.feetech._cycle import FeetechExchange

GOAL_BLOCK: Final = (table.ACCELERATION.address, table.GOAL_SPEED.end - table.ACCELERATION.address)
"""Address and size of a command to move: a goal always with its speed."""


def goal_block(goal: Goal) -> bytes:
    """Returns the bytes from acceleration to goal speed."""
    return b"".join(
        (
            table.ACCELERATION.encode(goal.accel),
            table.GOAL_POSITION.encode(goal.position),
            table.GOAL_TIME.encode(0),
            table.GOAL_SPEED.encode(goal.speed * table.STEPS_PER_SPEED),
        )
    )


def relaxing(bus: "FeetechExchange", job: Work[FeetechAxis], axis: FeetechAxis) -> Steps:
    """Switches torque off."""
    axis.ready = False  # first, since a health read in between would take torque off for a fault
    yield from written(bus, job, axis, table.TORQUE, 0)
    health = yield from health_of(bus, axis)
    if health.torque:
        raise axis.faulty("it did not relax: its torque is still on")


def leaving(bus: "FeetechExchange", job: Work[FeetechAxis], axis: FeetechAxis, *, relax: bool) -> Steps:
    """Switches torque off or leaves it on; there is no watchdog to disarm."""
    axis.ready = False
    if relax:
        yield from relaxing(bus, job, axis)


def enabling(bus: "FeetechExchange", job: Work[FeetechAxis], axis: FeetechAxis) -> Steps:
    """Switches torque on at the measured position with the joint's acceleration and speed; reads all back."""
    bus.require_answering(axis)
    health = yield from health_of(bus, axis)
    if health.error and health.torque:  # only a switch off and on ends an overload
        axis.ready = False
        yield from written(bus, job, axis, table.TORQUE, 0)
        health = yield from health_of(bus, axis)
    if health.error:
        raise axis.faulty()
    yield from as_set(bus, axis)
    if not health.locked:
        yield from written(bus, job, axis, table.LOCK, 1)
        health = yield from health_of(bus, axis)
    block = yield from tried(bus, axis, lambda: _seeded(bus, job, axis))
    yield from written(bus, job, axis, table.TORQUE, table.TORQUE_ON)
    axis.ready = False
    health = yield from health_of(bus, axis)
    kept = yield from tried(bus, axis, lambda: bus.wire.read(axis.id, *GOAL_BLOCK).data)
    if not health.torque or kept != block:
        raise axis.faulty("it did not keep what enabling it wrote")
    axis.fault, axis.ready = "", True


def _seeded(bus: "FeetechExchange", job: Work[FeetechAxis], axis: FeetechAxis) -> bytes:
    """Sets the goal to the measured position, which may switch torque on; measures again at each retry."""
    asked_ns = bus.clock()
    health = axis.take_health(bus.wire.read(axis.id, *axis.slow).data, asked_ns)
    goal = axis.seed(health.position)
    block = goal_block(goal)
    axis.aim, axis.sent = None, goal.position
    bus.wire.write(axis.id, GOAL_BLOCK[0], block, job.gate)
    return block
