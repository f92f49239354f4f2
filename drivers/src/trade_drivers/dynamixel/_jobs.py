"""What enabling, relaxing and leaving a servo are made of: one exchange on the wire after the other."""

from typing import TYPE_CHECKING, Final

from trade_drivers.dynamixel import _table as table
from trade_drivers.dynamixel._axis import DynamixelAxis
from trade_drivers.joints import Goal, Job, Steps
from trade_drivers.servos import health_of, still_homed, told, tried

if TYPE_CHECKING:
    from trade_drivers.dynamixel._exchange import DynamixelExchange

__all__ = ["enabling", "goal_block", "leaving", "relaxing"]

_GOAL_BLOCK: Final = (
    table.PROFILE_ACCELERATION.address,
    table.GOAL_POSITION.end - table.PROFILE_ACCELERATION.address,
)


def goal_block(goal: Goal) -> bytes:
    """What goes from profile acceleration to goal position."""
    return b"".join(
        (
            table.PROFILE_ACCELERATION.encode(goal.accel),
            table.PROFILE_VELOCITY.encode(goal.speed),
            table.GOAL_POSITION.encode(goal.position),
        )
    )


def relaxing(bus: "DynamixelExchange", job: Job, axis: DynamixelAxis) -> Steps:
    """Torque off, and its watchdog disarmed."""
    axis.ready = False  # before: its health may be read in between, and torque that is off would be a fault
    yield from _write(bus, job, axis, table.TORQUE_ENABLE, 0)
    yield from _write(bus, job, axis, table.BUS_WATCHDOG, 0)
    health = yield from health_of(bus, axis)
    if health.torque:
        raise axis.faulty("told to relax, but its torque is still on")


def leaving(bus: "DynamixelExchange", job: Job, axis: DynamixelAxis, *, relax: bool) -> Steps:
    """Torque off or left on, and its watchdog disarmed where it may be."""
    health = yield from health_of(bus, axis)
    if relax and health.torque:
        axis.ready = False
        yield from _write(bus, job, axis, table.TORQUE_ENABLE, 0)
    elif health.watchdog == table.WATCHDOG_EXPIRED or axis.still == 0:
        return
    if health.watchdog:
        yield from _write(bus, job, axis, table.BUS_WATCHDOG, 0)
    axis.ready = False


def enabling(bus: "DynamixelExchange", job: Job, axis: DynamixelAxis) -> Steps:
    """Torque on at the measured position, with the joint's own profile and its watchdog armed; all of it read back."""
    bus.require_answering(axis)
    health = yield from health_of(bus, axis)
    if health.error:
        raise axis.faulty()
    yield from still_homed(bus, axis)
    if health.watchdog:
        yield from _write(bus, job, axis, table.BUS_WATCHDOG, 0)
    register = table.PRESENT_POSITION
    answer = yield from tried(bus, axis, lambda: bus.wire.read(axis.id, register.address, register.size))
    position = register.decode(answer.data, register.address)
    block = goal_block(Goal(position, axis.accel_counts, axis.speed_counts))
    yield from told(bus, job, axis, _GOAL_BLOCK[0], block)
    armed = bus.watchdog_counts
    yield from _write(bus, job, axis, table.BUS_WATCHDOG, armed)
    yield from _write(bus, job, axis, table.TORQUE_ENABLE, 1)
    axis.ready = False
    health = yield from health_of(bus, axis)
    kept = yield from tried(bus, axis, lambda: bus.wire.read(axis.id, *_GOAL_BLOCK).data)
    if not health.torque or health.watchdog != armed or kept != block:
        raise axis.faulty("it did not keep what enabling it wrote")
    axis.fault, axis.ready = "", True


def _write(bus: "DynamixelExchange", job: Job, axis: DynamixelAxis, register: table.Register, value: int) -> Steps:
    yield from told(bus, job, axis, register.address, register.encode(value))
