"""What enabling, relaxing and leaving a servo are made of: one exchange on the wire after the other."""

from collections.abc import Callable, Generator
from typing import TYPE_CHECKING, Final, TypeVar

from trade.errors import DeadlineExceeded, DeviceSilent, OutcomeUnknown
from trade_drivers.dynamixel import _table as table
from trade_drivers.dynamixel._axis import SLOW, Health, ServoAxis
from trade_drivers.dynamixel._wire import NoAnswer, Refused
from trade_drivers.joints import Goal, Job, Steps

if TYPE_CHECKING:
    from trade_drivers.dynamixel._exchange import ServoExchange

__all__ = ["enabling", "goal_block", "leaving", "read_health", "relaxing"]

_Result = TypeVar("_Result")
_ATTEMPTS: Final = 3
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


def relaxing(bus: "ServoExchange", job: Job, axis: ServoAxis) -> Steps:
    """Torque off, and its watchdog disarmed."""
    axis.ready = False  # before: its health may be read in between, and torque that is off would be a fault
    yield from _write(bus, job, axis, table.TORQUE_ENABLE, 0)
    yield from _write(bus, job, axis, table.BUS_WATCHDOG, 0)
    health = yield from read_health(bus, axis)
    if health.torque:
        raise axis.faulty("told to relax, but its torque is still on")


def leaving(bus: "ServoExchange", job: Job, axis: ServoAxis, *, relax: bool) -> Steps:
    """Torque off or left on, and its watchdog disarmed where it may be."""
    health = yield from read_health(bus, axis)
    if relax and health.torque:
        axis.ready = False
        yield from _write(bus, job, axis, table.TORQUE_ENABLE, 0)
    elif health.watchdog == table.WATCHDOG_EXPIRED or axis.still == 0:
        return
    if health.watchdog:
        yield from _write(bus, job, axis, table.BUS_WATCHDOG, 0)
    axis.ready = False


def enabling(bus: "ServoExchange", job: Job, axis: ServoAxis) -> Steps:
    """Torque on at the measured position, with the joint's own profile and its watchdog armed; all of it read back."""
    bus.require_answering(axis)
    health = yield from read_health(bus, axis)
    if health.error:
        raise axis.faulty()
    if health.watchdog:
        yield from _write(bus, job, axis, table.BUS_WATCHDOG, 0)
    position = yield from _read_position(bus, axis)
    block = goal_block(Goal(position, axis.accel_counts, axis.speed_counts))
    yield from _write(bus, job, axis, table.PROFILE_ACCELERATION, block)
    armed = bus.watchdog_counts
    yield from _write(bus, job, axis, table.BUS_WATCHDOG, armed)
    yield from _write(bus, job, axis, table.TORQUE_ENABLE, 1)
    axis.ready = False
    health = yield from read_health(bus, axis)
    kept = yield from _try(bus, axis, lambda: bus.wire.read(axis.id, *_GOAL_BLOCK).data)
    if not health.torque or health.watchdog != armed or kept != block:
        raise axis.faulty("it did not keep what enabling it wrote")
    axis.fault, axis.ready = "", True


def _write(bus: "ServoExchange", job: Job, axis: ServoAxis, register: table.Register, value: int | bytes) -> Steps:
    data = value if isinstance(value, bytes) else register.encode(value)
    yield from _try(bus, axis, lambda: bus.wire.write(axis.id, register.address, data, job.gate))


def read_health(bus: "ServoExchange", axis: ServoAxis) -> Generator[None, None, Health]:
    """How it is, asked now."""

    def read() -> Health:
        asked_ns = bus.clock()
        return Health.decode(bus.wire.read(axis.id, *SLOW).data, asked_ns)

    health = yield from _try(bus, axis, read)
    axis.take_health(health)
    return health


def _read_position(bus: "ServoExchange", axis: ServoAxis) -> Generator[None, None, int]:
    register = table.PRESENT_POSITION
    answer = yield from _try(bus, axis, lambda: bus.wire.read(axis.id, register.address, register.size))
    return register.decode(answer.data, register.address)


def _try(bus: "ServoExchange", axis: ServoAxis, act: Callable[[], _Result]) -> Generator[None, None, _Result]:
    """One exchange within the retry budget; a ping before each retry keeps late answers from being taken for new."""
    asked = False
    for _ in range(_ATTEMPTS):
        try:
            if asked:
                bus.wire.ping(axis.id)
                yield
            result = act()
        except DeadlineExceeded as late:
            if asked:  # it went out before, and nobody heard what became of it
                raise OutcomeUnknown(service=late.service, deadline_s=late.deadline_s) from None
            raise
        except NoAnswer as silent:
            asked, waited_s = True, silent.waited_s
            yield
        except Refused as refused:
            raise axis.faulty(f"it refused a command: {refused}") from None
        else:
            yield
            return result
    raise DeviceSilent(device=axis.name, bus=axis.bus, waited_s=waited_s * _ATTEMPTS)  # pyright: ignore[reportPossiblyUnboundVariable]
