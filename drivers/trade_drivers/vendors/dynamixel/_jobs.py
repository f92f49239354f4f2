"""The steps of enabling, relaxing and leaving a servo: one exchange after the other."""

from collections.abc import Generator
from contextlib import suppress
from typing import TYPE_CHECKING, Final

from trade_drivers.joints import Goal, Steps, Work
from trade_drivers.joints.serial import NoAnswer, as_set, health_of, tried, written
from trade_drivers.vendors.dynamixel import _table as table
from trade_drivers.vendors.dynamixel._axis import DynamixelAxis, DynamixelHealth

if TYPE_CHECKING:
    from trade_drivers.vendors.dynamixel._cycle import DynamixelExchange

_BOOT_NS: Final = 2_000_000_000
"""The time allowed for a servo to restart and to be accepted again."""
_WAIT_S: Final = 0.001
_GOAL_BLOCK: Final = (
    table.PROFILE_ACCELERATION.address,
    table.GOAL_POSITION.end - table.PROFILE_ACCELERATION.address,
)


def goal_block(goal: Goal) -> bytes:
    """Returns the bytes from profile acceleration to goal position."""
    return b"".join(
        (
            table.PROFILE_ACCELERATION.encode(goal.accel),
            table.PROFILE_VELOCITY.encode(goal.speed),
            table.GOAL_POSITION.encode(goal.position),
        )
    )


def relaxing(bus: "DynamixelExchange", job: Work[DynamixelAxis], axis: DynamixelAxis) -> Steps:
    """Switches torque off and disarms the watchdog."""
    axis.ready = False  # first, since a health read in between would take torque off for a fault
    yield from written(bus, job, axis, table.TORQUE_ENABLE, 0)
    yield from written(bus, job, axis, table.BUS_WATCHDOG, 0)
    health = yield from health_of(bus, axis)
    if health.torque:
        raise axis.faulty("it did not relax: its torque is still on")


def leaving(bus: "DynamixelExchange", job: Work[DynamixelAxis], axis: DynamixelAxis, *, relax: bool) -> Steps:
    """Switches torque off or leaves it on, and disarms the watchdog where that is allowed."""
    health = yield from health_of(bus, axis)
    if relax and health.torque:
        axis.ready = False
        yield from written(bus, job, axis, table.TORQUE_ENABLE, 0)
    elif health.watchdog == table.WATCHDOG_EXPIRED or axis.still == 0:
        return
    if health.watchdog:
        yield from written(bus, job, axis, table.BUS_WATCHDOG, 0)
    axis.ready = False


def enabling(bus: "DynamixelExchange", job: Work[DynamixelAxis], axis: DynamixelAxis) -> Steps:
    """Switches torque on at the measured position with the joint's profile and an armed watchdog; reads all back."""
    bus.require_answering(axis)
    health = yield from health_of(bus, axis)
    if health.error and health.torque:
        raise axis.faulty(f"{axis.fault}, and it has not let go: call relax() before enable()")
    if health.error:
        health = yield from _restarted(bus, job, axis)
    if health.error:
        raise axis.faulty()
    yield from as_set(bus, axis)
    if health.watchdog:
        yield from written(bus, job, axis, table.BUS_WATCHDOG, 0)
    block = yield from tried(bus, axis, lambda: _seeded(bus, job, axis))
    armed = bus.watchdog_counts
    yield from written(bus, job, axis, table.BUS_WATCHDOG, armed)
    yield from written(bus, job, axis, table.TORQUE_ENABLE, 1)
    axis.ready = False
    health = yield from health_of(bus, axis)
    kept = yield from tried(bus, axis, lambda: bus.wire.read(axis.id, *_GOAL_BLOCK).data)
    if not health.torque or health.watchdog != armed or kept != block:
        raise axis.faulty("it did not keep what enabling it wrote")
    axis.fault, axis.ready = "", True


def _seeded(bus: "DynamixelExchange", job: Work[DynamixelAxis], axis: DynamixelAxis) -> bytes:
    """Sets the goal to the measured position; measures again at each retry, as the joint may have sagged."""
    register = table.PRESENT_POSITION
    answer = bus.wire.read(axis.id, register.address, register.size)
    position = register.decode(answer.data, register.address)
    block = goal_block(axis.seed(position))
    bus.wire.write(axis.id, _GOAL_BLOCK[0], block, job.gate)
    return block


def _restarted(
    bus: "DynamixelExchange", job: Work[DynamixelAxis], axis: DynamixelAxis
) -> Generator[None, None, DynamixelHealth]:
    """Restarts a servo that has shut down, and returns its health; only a restart or power cycle ends a shutdown."""
    axis.ready = False
    began_ns = bus.clock()
    with suppress(NoAnswer):  # its next answer shows whether it restarted
        bus.wire.reboot(axis.id, job.gate)
    while True:
        bus.idle(_WAIT_S)
        yield
        now_ns, health = bus.clock(), axis.health
        heard = None if axis.silent or axis.doubted or health is None or health.at_ns <= began_ns else health
        if heard is not None and (not heard.error or now_ns - began_ns > _BOOT_NS):
            return heard
        if now_ns - began_ns > 2 * _BOOT_NS:
            raise axis.deaf(now_ns)
