"""The steps of enabling, relaxing, homing and leaving a drive: one exchange after the other."""

from typing import TYPE_CHECKING, Final

from trade.errors import DeviceSilent
from trade_drivers.bus._cycle import HALT_NS
from trade_drivers.joints import Steps, Work, next_measurement, until
from trade_drivers.vendors.cia402 import _machine as machine
from trade_drivers.vendors.cia402 import _table as table
from trade_drivers.vendors.cia402._axis import DriveAxis
from trade_drivers.vendors.cia402._machine import State
from trade_drivers.vendors.cia402._net import NoAnswer, Refused
from trade_drivers.vendors.cia402._stream import Following
from trade_drivers.vendors.cia402._table import Entry

if TYPE_CHECKING:
    from trade_drivers.vendors.cia402._cycle import DriveExchange

_WAIT_S: Final = 0.001
_TAKEN_BACK_NS: Final = 5_000_000_000
_AT_REST: Final = 2
"""Consecutive measurements without motion."""


def enabling(bus: "DriveExchange", job: Work[DriveAxis], axis: DriveAxis, mode: int) -> Steps:
    """Switches torque on at the measured position, halted or with that as its target; confirms each step.

    A drive that is already enabled must be at rest: then only its mode changes. A homing ends.
    """
    if axis.stopped:
        yield from _take_back(bus, job, axis)
    yield from looking(bus, axis)
    axis.check_zero()
    axis.check_place(axis.fresh(bus.clock(), bus.stale_after_ns))
    if axis.motion is not None and not axis.fault:
        bus.end_motion(axis, f"{axis.name} was enabled again")
    if not axis.statusword & machine.REMOTE:
        raise axis.fault_error("it does not obey the bus (statusword bit 9), as if operated from its panel")
    if axis.state_now is State.FAULT:
        yield from _reset(bus, job, axis)
    yield from _begin_at_rest(bus, job, axis)
    yield from set_mode(bus, job, axis, mode)
    for entry, value in (
        (table.PROFILE_VELOCITY, axis.speed_counts),
        (table.ACCELERATION, axis.accel_counts),
        (table.DECELERATION, axis.accel_counts),
    ):
        yield from write(bus, job, axis, entry, value)
    yield from _climb(bus, job, axis, mode)
    axis.fault, axis.ready, axis.entered, axis.raised_ns = "", True, mode, 0
    axis.stream = bus.stream_for(axis, mode, axis.target)


def _take_back(bus: "DriveExchange", job: Work[DriveAxis], axis: DriveAxis) -> Steps:
    """Restarts a drive stopped by network management, and sets it up like one that was offline."""
    give_up_ns = bus.clock() + _TAKEN_BACK_NS
    axis.recalled = True
    try:
        while axis.silent:
            job.gate()
            if bus.clock() > give_up_ns:
                raise axis.absence(bus.clock())
            bus.recall(axis)
            bus.idle(_WAIT_S)
            yield
    finally:
        axis.recalled = False
    job.note("taken back from network management's stop: pre-operational, and set up")


def _begin_at_rest(bus: "DriveExchange", job: Work[DriveAxis], axis: DriveAxis) -> Steps:
    """Clears old targets, which could move it in another mode."""
    if axis.may_hold_torque:
        yield from until(
            bus, axis, lambda: axis.still >= _AT_REST, "its mode cannot be changed while it moves", HALT_NS
        )
    sample = axis.fresh(bus.clock(), bus.stale_after_ns)
    job.gate()
    bus.port.send(table.BRAKING.base + axis.id, axis.braking(axis.accel_counts))
    if axis.state_now is State.ENABLED:
        target = axis.stream.target if isinstance(axis.stream, Following) else sample.position
        bus.command(axis, machine.HOLD, target)
    axis.entered, axis.stream = 0, None


def resting(bus: "DriveExchange", job: Work[DriveAxis], axis: DriveAxis) -> Steps:
    """Ends its motion on the drive's own ramp."""
    job.gate()
    bus.halt([axis], "another kind of motion took over")
    yield from until(bus, axis, lambda: axis.still >= _AT_REST, "a halt was sent, but it is still moving", HALT_NS)


def _climb(bus: "DriveExchange", job: Work[DriveAxis], axis: DriveAxis, mode: int) -> Steps:
    """Steps through the states to enabled, with the measured position as goal.

    The drive is then halted, except in a mode without a goal, where not all drives support halt.
    """
    while True:
        yield from until(bus, axis, lambda: machine.command_towards_enabled(axis.state_now) is not None, _stays(axis))
        word = machine.command_towards_enabled(axis.state_now) or 0
        if mode != table.PROFILE_POSITION:
            word &= ~machine.HALT
        sample = axis.fresh(bus.clock(), bus.stale_after_ns)
        before = axis.state_now
        job.gate()
        bus.command(axis, word, sample.position)
        if before is State.ENABLED:
            return
        yield from until(bus, axis, lambda: axis.state_now is not before, _stays(axis))  # noqa: B023 - over before the next round


def _stays(axis: DriveAxis) -> str:
    if axis.fault and axis.state_now is State.FAULT:
        return axis.fault
    state = axis.state_now.name.lower().replace("_", " ") if axis.state_now else f"{axis.statusword:04X}h"
    return f"it cannot be enabled: it stays at {state}; is its power stage supplied, and its safe torque off released?"


def _reset(bus: "DriveExchange", job: Work[DriveAxis], axis: DriveAxis) -> Steps:
    """Clears the drive's own fault, without enabling it."""
    for word in (machine.DISABLE_VOLTAGE, machine.RESET_FAULT):
        job.gate()
        bus.command(axis, word)
        yield from next_measurement(bus, axis)
    yield from until(
        bus, axis, lambda: axis.state_now is not State.FAULT, f"its fault cannot be cleared: {axis.fault or 'it stays'}"
    )


def set_mode(bus: "DriveExchange", job: Work[DriveAxis], axis: DriveAxis, mode: int) -> Steps:
    """Changes the mode of operation, and waits until the drive reports it."""
    yield from write(bus, job, axis, table.MODE, mode)
    yield from until(bus, axis, lambda: axis.mode == mode, f"it does not enter mode {mode} (6061h)")


def relaxing(bus: "DriveExchange", job: Work[DriveAxis], axis: DriveAxis) -> Steps:
    """Switches torque off; the watchdog stays armed."""
    axis.ready = False
    if axis.may_hold_torque:
        job.gate()
        bus.command(axis, machine.DISABLE_VOLTAGE)
    yield from until(bus, axis, lambda: not axis.may_hold_torque, "it did not relax: its torque is still on")


def leaving(bus: "DriveExchange", job: Work[DriveAxis], axis: DriveAxis, *, relax: bool) -> Steps:
    """Switches torque off, or leaves it on for a joint seen at rest, and only then disarms the watchdog."""
    if relax:
        yield from relaxing(bus, job, axis)
    elif axis.still == 0 and axis.may_hold_torque:
        return
    yield from write(bus, job, axis, table.CONSUMER_HEARTBEAT, 0)
    axis.ready = False


def looking(bus: "DriveExchange", axis: DriveAxis) -> Steps:
    """Waits for the measurement of the next SYNC."""
    bus.require_answering(axis)
    yield from next_measurement(bus, axis)


def write(bus: "DriveExchange", job: Work[DriveAxis], axis: DriveAxis, entry: Entry, value: int) -> Steps:
    """Writes to its dictionary, with confirmation.

    Raises:
        DeviceFault: the drive refused.
        DeviceSilent: the drive did not answer.
    """
    began_ns = bus.clock()
    bus.require_answering(axis)
    try:
        for _ in bus.nodes.write(axis.id, entry, value, job.gate):
            bus.net.take_in(_WAIT_S)
            yield
            bus.require_answering(axis)
    except NoAnswer:
        raise DeviceSilent(device=axis.name, bus=axis.bus, waited_s=(bus.clock() - began_ns) / 1e9) from None
    except Refused as refused:
        raise axis.fault_error(f"it refused a command: {refused}") from None
