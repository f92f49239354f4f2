"""Exchanges with one servo within a retry budget, as steps of jobs."""

from collections.abc import Callable, Generator
from typing import Any, TypeVar

from trade.errors import DeadlineExceeded, DeviceSilent, OutcomeUnknown, WrongDevice
from trade_drivers.bus._attempts import attempts
from trade_drivers.bus._jobs import NoAnswer, Refused
from trade_drivers.joints import Steps, Work
from trade_drivers.joints.serial._axis import Health, Register, ServoAxis
from trade_drivers.joints.serial._cycle import ServoExchange

_Result = TypeVar("_Result")
_Health = TypeVar("_Health", bound=Health)
AnyExchange = ServoExchange[Any, Any]


def written(bus: AnyExchange, job: Work[Any], axis: ServoAxis[Any], register: Register, value: int) -> Steps:
    """Writes a register and waits for the confirmation."""
    data = register.encode(value)
    yield from tried(bus, axis, lambda: bus.wire.write(axis.id, register.address, data, job.gate))


def health_of(bus: AnyExchange, axis: ServoAxis[_Health]) -> Generator[None, None, _Health]:
    """Reads the servo's health now."""

    def look() -> _Health:
        asked_ns = bus.clock()
        return axis.take_health(bus.wire.read(axis.id, *axis.slow).data, asked_ns)

    return (yield from tried(bus, axis, look))


def tried(bus: AnyExchange, axis: ServoAxis[Any], act: Callable[[], _Result]) -> Generator[None, None, _Result]:
    """Runs one exchange within the retry budget; a ping before each retry discards late answers."""
    asked, began_ns = False, bus.clock()
    for _ in attempts(bus.clock, bus.stale_after_ns):
        try:
            if asked:
                bus.wire.ping(axis.id)
                yield
            result = act()
        except DeadlineExceeded as late:
            if asked:  # an earlier attempt was sent, and its outcome is unknown
                raise OutcomeUnknown(service=late.service, deadline_s=late.deadline_s) from None
            raise
        except NoAnswer:
            asked = axis.doubted = True
            yield
        except Refused as refused:
            raise axis.faulty(f"it refused a command: {refused}") from None
        else:
            yield
            return result
    waited_s = (bus.clock() - began_ns) / 1e9
    raise DeviceSilent(device=axis.name, bus=axis.bus, waited_s=waited_s, reason=bus.why_silent())


def check_homing(axis: ServoAxis[Any], settings: bytes, key: str) -> None:
    """Raises ``WrongDevice`` for a servo with another zero; ``settings`` are its registers from address 0."""
    if problem := axis.zero_moved(settings):
        expected, found = str(axis.joint.homing_counts), str(axis.homing.decode(settings))
        raise WrongDevice(where=key, key="homing_counts", expected=expected, found=found, problem=problem)


def as_set(bus: AnyExchange, axis: ServoAxis[Any]) -> Steps:
    """Compares a servo with the robot file again, as it may have lost settings or have been replaced.

    Raises:
        DeviceFault: its zero has moved, it is set otherwise, or it cannot hold where it is.
    """
    answer = yield from tried(bus, axis, lambda: bus.wire.read(axis.id, *axis.settings))
    if problem := bus.misfit(axis, answer.data):
        raise axis.faulty(problem)
    if axis.sample is not None:
        axis.seed(axis.sample.position)
