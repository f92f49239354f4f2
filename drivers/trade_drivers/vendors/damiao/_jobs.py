"""The steps of enabling, relaxing and leaving a motor: one exchange after the other."""

from typing import TYPE_CHECKING, Final

from trade_drivers.bus._cycle import HALT_NS
from trade_drivers.bus._jobs import NoAnswer
from trade_drivers.joints import Steps, Unfit, Work, next_measurement, until
from trade_drivers.vendors.damiao import _frames as frames
from trade_drivers.vendors.damiao._axis import DamiaoAxis
from trade_drivers.vendors.damiao._frames import Register
from trade_drivers.vendors.damiao._inspect import check_ranges, register, set_register

if TYPE_CHECKING:
    from trade_drivers.vendors.damiao._cycle import DamiaoExchange

_WAIT_S: Final = 0.001


def enabling(bus: "DamiaoExchange", job: Work[DamiaoAxis], axis: DamiaoAxis) -> Steps:
    """Switches torque on at the measured position in position-velocity mode; confirms each step."""
    bus.require_answering(axis)
    yield from next_measurement(bus, axis)
    if axis.motion is not None and not axis.fault:
        bus.end_motion(axis, f"{axis.name} was enabled again")
    if axis.torque:
        yield from until(bus, axis, lambda: axis.still > 1, "it cannot be enabled while it moves", HALT_NS)
    if axis.failed:
        job.gate()
        complaint = axis.complaint
        bus.port.send(axis.id, frames.CLEAR)
        yield from until(bus, axis, lambda: not axis.failed, f"{complaint}; it cannot be cleared")
    yield from _set_up(bus, job, axis)
    yield from next_measurement(bus, axis)
    axis.check_zero()
    job.gate()
    bus.stand(axis)
    bus.enable(axis)
    yield from until(bus, axis, lambda: axis.torque is True, "it cannot be enabled; is its power stage supplied?")
    axis.fault, axis.ready = "", True


def _set_up(bus: "DamiaoExchange", job: Work[DamiaoAxis], axis: DamiaoAxis) -> Steps:
    """Compares its scale, and sets timeout and mode, each time: a restart, which is not reported, may change all."""
    yield from _heard(bus, axis, check_ranges(bus, axis))
    job.gate()
    yield from _written(bus, axis, Register.TIMEOUT, bus.timeout)
    yield from _heard(bus, axis, register(bus, axis, Register.CONTROL_MODE))
    if axis.answer == frames.IN_POSITION_VELOCITY:
        return
    if axis.torque:  # it would move to its last set-point in that mode, however old
        yield from relaxing(bus, job, axis)
    job.gate()
    yield from _written(bus, axis, Register.CONTROL_MODE, frames.IN_POSITION_VELOCITY)


def relaxing(bus: "DamiaoExchange", job: Work[DamiaoAxis], axis: DamiaoAxis) -> Steps:
    """Switches torque off, which also idles the watchdog."""
    axis.ready = False
    job.gate()
    axis.course = None
    if axis.may_hold_torque:
        bus.port.send(axis.id, frames.DISABLE)
    yield from until(bus, axis, lambda: not axis.may_hold_torque, "it did not relax: its torque is still on")


def leaving(bus: "DamiaoExchange", job: Work[DamiaoAxis], axis: DamiaoAxis, *, relax: bool) -> Steps:
    """Switches torque off, or leaves it on for a joint seen at rest, and only then disarms the watchdog."""
    if relax:
        yield from relaxing(bus, job, axis)
        return
    if axis.still == 0 and axis.may_hold_torque:
        return
    yield from _written(bus, axis, Register.TIMEOUT, 0)
    axis.ready, axis.course = False, None


def _written(bus: "DamiaoExchange", axis: DamiaoAxis, number: Register, value: int) -> Steps:
    """Writes a register and reads it back; raises ``DeviceFault`` if the value was not kept."""
    yield from _heard(bus, axis, set_register(bus, axis, number, value))
    if axis.answer != value:
        raise axis.fault_error(f"it does not keep register {number:d}: {axis.answer}, not {value}")


def _heard(bus: "DamiaoExchange", axis: DamiaoAxis, asking: Steps) -> Steps:
    """Runs register exchanges; raises ``DeviceSilent`` for a missing answer, and ``DeviceFault`` for ``Unfit``."""
    try:
        for _ in asking:
            bus.idle(_WAIT_S)
            yield
    except NoAnswer:
        raise axis.silent_error(bus.clock()) from None
    except Unfit as unfit:
        raise axis.fault_error(str(unfit)) from None
