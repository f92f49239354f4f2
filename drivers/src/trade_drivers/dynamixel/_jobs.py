"""What services ask of the bus thread: work of several exchanges, done one exchange at a time between the cycles."""

import threading
from collections.abc import Callable, Generator, Sequence
from typing import TYPE_CHECKING, Final, TypeVar

from trade import Permit
from trade.errors import DeadlineExceeded, DeviceSilent, OutcomeUnknown, TradeError
from trade_drivers.dynamixel import _table as table
from trade_drivers.dynamixel._axis import SLOW, Axis, Health
from trade_drivers.dynamixel._wire import NoAnswer, Refused

if TYPE_CHECKING:
    from trade_drivers.dynamixel._exchange import Exchange

__all__ = ["Command", "Enable", "Halt", "Job", "Leave", "Relax", "Steps", "StopTicket", "enabling"]

Steps = Generator[None, None, None]
"""Yields after each exchange on the wire, so that stops and cycles come in between."""

_Result = TypeVar("_Result")
_ATTEMPTS: Final = 3
_TELL_S: Final = 0.1
_GOAL_BLOCK: Final = (
    table.PROFILE_ACCELERATION.address,
    table.GOAL_POSITION.end - table.PROFILE_ACCELERATION.address,
)


class Job:
    """Something that is waited for. As it stands it needs no leave: it ends motion."""

    def __init__(self, exchange: "Exchange", axes: Sequence[Axis]) -> None:
        self.exchange = exchange
        self.axes = tuple(axes)
        self._ended = threading.Event()
        self._error: TradeError | None = None
        self._steps: Steps | None = None

    @property
    def ended(self) -> bool:
        """Its outcome is known."""
        return self._ended.is_set()

    def gate(self) -> None:
        """The last look before its bytes go out; what it raises keeps them in."""

    def steps(self) -> Steps:
        """The work."""
        raise NotImplementedError

    def step(self) -> bool:
        """Do one exchange of it; False when nothing is left to do."""
        if self._steps is None:
            self._steps = self.steps()
        try:
            next(self._steps)
        except StopIteration:
            return False
        except TradeError as problem:
            self.finish(problem)
            return False
        return True

    def done_stepping(self) -> None:
        """All its exchanges have been made."""
        self.finish()

    def finish(self, error: TradeError | None = None) -> None:
        """Let the waiting service have the outcome; only the first counts."""
        if not self._ended.is_set():
            self._error = error
            self._ended.set()

    def wait(self, alive: Callable[[], bool], tell: Callable[[], None] | None = None) -> None:
        """Block until it has ended; call ``tell`` ten times a second meanwhile.

        Raises:
            TradeError: what became of it.
        """
        while not self._ended.wait(1.0 if tell is None else _TELL_S):
            if tell is not None:
                tell()
            if not alive():
                self.finish(self.axes[0].faulty("the thread of its bus has ended"))
        if self._error is not None:
            raise self._error


class Command(Job):
    """What may set something moving: it carries an expiry, and the permit under which its call was admitted."""

    def __init__(
        self, exchange: "Exchange", axes: Sequence[Axis], *, service: str, expires_ns: int, permit: Permit
    ) -> None:
        super().__init__(exchange, axes)
        self.service = service
        self.expires_ns = expires_ns
        self.permit = permit
        self._admitted_ns = exchange.clock()

    def gate(self) -> None:
        """The last look before its bytes go out.

        Raises:
            DeadlineExceeded: it is late, and late is never.
            MotionStopped, LockLost, LockedByOther: a stop, or another owner, came after it was admitted.
        """
        if self.exchange.clock() >= self.expires_ns:
            patience_s = (self.expires_ns - self._admitted_ns) / 1e9
            raise DeadlineExceeded(service=self.service, deadline_s=max(0.0, patience_s))
        self.permit.gate()


class StopTicket(Job):
    """A stop: it has no expiry and needs no permit, and ends when all its joints are at rest."""

    def __init__(self, exchange: "Exchange", axes: Sequence[Axis], reason: str) -> None:
        super().__init__(exchange, axes)
        self.reason = reason


class Enable(Command):
    """Torque on, holding where the joints are. A joint that is enabled already is only looked at, not disturbed."""

    def steps(self) -> Steps:
        for axis in self.axes:
            if axis.ready:
                yield from _read_health(self, axis)
            if not axis.ready:
                yield from enabling(self, axis)


class Halt(Command):
    """Whatever moves the joints ends, and they hold; unlike a stop it needs leave and makes nothing void."""

    def steps(self) -> Steps:
        self.gate()
        self.exchange.halt(self.axes, f"{self.service} said so")
        yield
        for axis in self.axes:
            _require_answering(self, axis)


class Relax(Command):
    """Torque off."""

    def steps(self) -> Steps:
        for axis in self.axes:
            _require_answering(self, axis)
            self.gate()
            self.exchange.end_motion(axis, f"{axis.name} was relaxed")
            axis.ready = False  # before: its health may be read in between, and torque that is off would be a fault
            yield from _write(self, axis, table.TORQUE_ENABLE, 0)
            yield from _write(self, axis, table.BUS_WATCHDOG, 0)
            health = yield from _read_health(self, axis)
            if health.torque:
                raise axis.faulty("told to relax, but its torque is still on")


class Leave(Job):
    """The driver goes, after it has stopped everything: hold or relax, as the robot file says.

    A joint that holds is disarmed once it was seen at rest: silence on the bus is then what is wanted, and an expired
    watchdog would only lock its goal for whoever comes next. Not seen at rest, or silent: its watchdog stays armed.
    """

    def __init__(self, exchange: "Exchange", axes: Sequence[Axis], *, relax: bool) -> None:
        super().__init__(exchange, axes)
        self._relax = relax

    def steps(self) -> Steps:
        for axis in self.axes:
            if axis.silent:
                continue
            try:
                yield from self._leave(axis)
            except TradeError as problem:
                self.finish(problem)

    def _leave(self, axis: Axis) -> Steps:
        health = yield from _read_health(self, axis)
        if self._relax and health.torque:
            axis.ready = False
            yield from _write(self, axis, table.TORQUE_ENABLE, 0)
        elif health.watchdog == table.WATCHDOG_EXPIRED or axis.still == 0:
            return
        if health.watchdog:
            yield from _write(self, axis, table.BUS_WATCHDOG, 0)
        axis.ready = False


def enabling(job: Job, axis: Axis) -> Steps:
    """Torque on at the measured position, with the joint's own profile and its watchdog armed; all of it read back."""
    _require_answering(job, axis)
    health = yield from _read_health(job, axis)
    if health.error:
        raise axis.faulty()
    if health.watchdog:
        yield from _write(job, axis, table.BUS_WATCHDOG, 0)
    position = yield from _read_position(job, axis)
    block = axis.goal_block(position)
    yield from _write(job, axis, table.PROFILE_ACCELERATION, block)
    armed = job.exchange.watchdog_counts
    yield from _write(job, axis, table.BUS_WATCHDOG, armed)
    yield from _write(job, axis, table.TORQUE_ENABLE, 1)
    axis.ready = False
    health = yield from _read_health(job, axis)
    kept = yield from _try(job, axis, lambda: job.exchange.wire.read(axis.id, *_GOAL_BLOCK).data)
    if not health.torque or health.watchdog != armed or kept != block:
        raise axis.faulty("it did not keep what enabling it wrote")
    axis.fault, axis.ready = "", True


def _require_answering(job: Job, axis: Axis) -> None:
    if axis.silent:
        raise axis.deaf(job.exchange.clock())


def _write(job: Job, axis: Axis, register: table.Register, value: int | bytes) -> Steps:
    data = value if isinstance(value, bytes) else register.encode(value)
    yield from _try(job, axis, lambda: job.exchange.wire.write(axis.id, register.address, data, job.gate))


def _read_health(job: Job, axis: Axis) -> Generator[None, None, Health]:
    def read() -> Health:
        asked_ns = job.exchange.clock()
        return Health.decode(job.exchange.wire.read(axis.id, *SLOW).data, asked_ns)

    health = yield from _try(job, axis, read)
    axis.take_health(health)
    return health


def _read_position(job: Job, axis: Axis) -> Generator[None, None, int]:
    register = table.PRESENT_POSITION
    answer = yield from _try(job, axis, lambda: job.exchange.wire.read(axis.id, register.address, register.size))
    return register.decode(answer.data, register.address)


def _try(job: Job, axis: Axis, act: Callable[[], _Result]) -> Generator[None, None, _Result]:
    """One exchange within the retry budget; a ping before each retry keeps late answers from being taken for new."""
    asked = False
    for _ in range(_ATTEMPTS):
        try:
            if asked:
                job.exchange.wire.ping(axis.id)
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
