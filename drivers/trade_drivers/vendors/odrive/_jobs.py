"""The steps of enabling, relaxing and leaving an axis: one exchange after the other."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from trade.errors import TradeError
from trade_drivers.bus._cycle import HALT_NS
from trade_drivers.joints import Steps, Work, next_measurement, until
from trade_drivers.vendors.odrive import _frames as frames
from trade_drivers.vendors.odrive._axis import OdriveAxis
from trade_drivers.vendors.odrive._frames import Command, Control, Errors, Input, State

if TYPE_CHECKING:
    from trade_drivers.vendors.odrive._cycle import OdriveExchange

_SLACK_NS: Final = 250_000_000
"""The delay allowed for the report that the watchdog expired: a heartbeat, and a busy host."""
_AT_REST: Final = 2
_WAIT_S: Final = 0.001


def enabling(bus: "OdriveExchange", job: Work[OdriveAxis], axis: OdriveAxis) -> Steps:
    """Switches torque on at the measured position after one test of the watchdog; heartbeats confirm each state.

    An axis that already has torque must be at rest, and keeps holding.
    """
    bus.require_answering(axis)
    yield from next_measurement(bus, axis)
    if axis.motion is not None and not axis.fault:
        bus.end_motion(axis, f"{axis.name} was enabled again")
    if axis.errors:
        yield from _clear(bus, job, axis)
    if not axis.armed and not axis.proven:
        others = [other for other in job.devices if other is not axis]
        idle = [other for other in others if not (other.proven or other.torque or other.errors or other.silent)]
        yield from _try_watchdogs(bus, job, [axis, *idle])
        yield from next_measurement(bus, axis)
    if axis.torque:
        yield from until(bus, axis, lambda: axis.still >= _AT_REST, "it cannot be enabled while it moves", HALT_NS)
    here = axis.fresh(bus.clock(), bus.stale_after_ns).position
    axis.check_zero()
    job.gate()
    bus.limit(axis, axis.speed_counts, axis.accel_counts)
    bus.tell(axis, Command.SET_MODE, frames.set_mode(Control.POSITION, Input.TRAJECTORY))
    bus.send_to(axis, here)
    if not axis.armed:
        yield from _arm(bus, job, axis)
    axis.fault, axis.ready = "", True


def _arm(bus: "OdriveExchange", job: Work[OdriveAxis], axis: OdriveAxis) -> Steps:
    job.gate()
    bus.tell(axis, Command.SET_STATE, frames.set_state(State.CLOSED_LOOP))
    since_ns = bus.clock()
    yield from until(bus, axis, lambda: axis.armed or _reported_since(axis, since_ns), "it does not answer")
    if not axis.armed:
        raise axis.fault_error(f"it cannot be enabled: {axis.refusal}")


def _reported_since(axis: OdriveAxis, since_ns: int) -> bool:
    """Returns whether a heartbeat long enough after the arm command shows that it is not armed."""
    return axis.beat_ns - since_ns > _SLACK_NS // 2


def _clear(bus: "OdriveExchange", job: Work[OdriveAxis], axis: OdriveAxis) -> Steps:
    """Clears its errors, without arming it."""
    job.gate()
    bus.tell(axis, Command.CLEAR_ERRORS, b"\0")
    since_ns = bus.clock()
    stays = f"error: {axis.errors.text}; it cannot be cleared"
    yield from until(bus, axis, lambda: axis.health_ns > since_ns and not axis.errors, stays)
    axis.disarmed_by = Errors(0)


def _try_watchdogs(bus: "OdriveExchange", job: Work[OdriveAxis], axes: Sequence[OdriveAxis]) -> Steps:
    """Tests the watchdogs, which no reading shows: arms axes without torque and waits in silence until they disarm."""
    job.gate()
    for axis in axes:
        axis.hushed = True
    try:
        for axis in axes:
            bus.tell(axis, Command.SET_MODE, frames.set_mode(Control.TORQUE, Input.PASSTHROUGH))
            bus.tell(axis, Command.SET_TORQUE, frames.set_torque(0.0))
            bus.tell(axis, Command.SET_STATE, frames.set_state(State.CLOSED_LOOP))
        give_up_ns = bus.clock() + bus.watchdog_ns + _SLACK_NS
        for axis in axes:
            yield from _await_watchdog(bus, job, axis, give_up_ns)
    except TradeError:
        for axis in axes:
            bus.tell(axis, Command.SET_STATE, frames.set_state(State.IDLE))
        raise
    finally:
        for axis in axes:
            axis.hushed = False
    for axis in axes:
        yield from _clear(bus, job, axis)
        axis.proven = True


def _await_watchdog(bus: "OdriveExchange", job: Work[OdriveAxis], axis: OdriveAxis, give_up_ns: int) -> Steps:
    while not axis.errors:
        job.gate()
        bus.require_answering(axis)
        if axis.beat_ns > give_up_ns:
            if not axis.armed:
                raise axis.fault_error(f"it cannot be enabled: {axis.refusal}")
            most_s = bus.watchdog_ns / 1e9
            raise axis.fault_error(
                f"its watchdog does not let go within {most_s:g} s; set axis0.config.enable_watchdog and "
                f"watchdog_timeout = {most_s:g}, or watchdog_s to what it is"
            )
        bus.idle(_WAIT_S)
        yield
    if not axis.errors & Errors.WATCHDOG:
        raise axis.fault_error(f"it cannot be enabled: {axis.refusal}")


def relaxing(bus: "OdriveExchange", job: Work[OdriveAxis], axis: OdriveAxis) -> Steps:
    """Switches torque off, which also idles the watchdog."""
    axis.ready = False
    if axis.may_hold_torque:
        job.gate()
        bus.tell(axis, Command.SET_STATE, frames.set_state(State.IDLE))
    yield from until(bus, axis, lambda: not axis.may_hold_torque, "it did not relax: its torque is still on")
