"""The cyclic exchange with all servos of one bus: stops, measurements, work, goals. One thread calls ``cycle()``."""

import logging
from abc import abstractmethod
from collections.abc import Callable, Generator, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Final, Generic, TypeVar

from trade.errors import ConfigurationError, DeadlineExceeded, DeviceSilent, OutcomeUnknown
from trade_drivers.bus._attempts import attempts
from trade_drivers.bus._cycle import PROBE_NS
from trade_drivers.bus._jobs import NoAnswer, RequestRefused
from trade_drivers.joints import AwaitedJob, Exchange, Motion, Steps
from trade_drivers.joints.serial._axis import Health, Register, ServoAxis
from trade_robotfile import SerialBus

if TYPE_CHECKING:
    from trade_drivers.joints.serial._wire import ServoWire

_log = logging.getLogger("trade")
_HEALTH_NS: Final = 500_000_000
_CLEAN_NS: Final = 1_000_000_000
_WAIT_S: Final = 0.001
_CHUNK_S: Final = 0.014
"""The maximum duration of one sync read; larger groups are split, so that a stop can be sent in between."""


_Result = TypeVar("_Result")
_Health = TypeVar("_Health", bound=Health)
_Servo = TypeVar("_Servo", bound=ServoAxis[Any])
_Wire_co = TypeVar("_Wire_co", bound="ServoWire", covariant=True)


class ServoExchange(Exchange[_Servo], Generic[_Servo, _Wire_co]):
    """The exchange with the servos of one bus."""

    sizes: ClassVar[tuple[int, ...]]
    """Sizes of the cyclic read; each failure selects the next one, so that a late answer has another length."""
    answer_overhead: ClassVar[int]
    """Bytes of overhead per joint in a cyclic exchange."""

    def __init__(
        self,
        wire: _Wire_co,
        bus: SerialBus,
        axes: Sequence[_Servo],
        clock: Callable[[], int] | None = None,
    ) -> None:
        super().__init__(bus, axes, clock)
        self._wire = wire
        self._chunk = max(1, int(_CHUNK_S * bus.baud / 10 / (self.answer_overhead + self.sizes[0])))
        self._attended_ns = self.lasting_clock()
        self._size = 0
        self._failed_ns = 0
        wire.pause = self.pause

    @property
    def wire(self) -> _Wire_co:
        """The line, for the bus thread only."""
        return self._wire

    def why_silent(self) -> str:
        return self.wire.intruder()

    # --- parts that differ between vendors

    @abstractmethod
    def admit(self, axis: _Servo) -> None:
        """Accepts a checked joint, and stops it if it moves."""

    @abstractmethod
    def check_settings(self, axis: _Servo, settings: bytes, key: str) -> None:
        """Compares the persistent registers of a joint with the robot file. Raises ``ConfigurationError``."""

    def name_of(self, model_number: int) -> str:
        """Returns the name of a model, or its number."""
        return str(model_number)

    def look_after(self, axis: _Servo) -> None:
        """Reacts to the health just read. Raises ``NoAnswer``."""

    def misfit(self, axis: _Servo, settings: bytes) -> str:
        """Returns in what a joint's persistent registers differ from the robot file; empty if in nothing."""
        if moved := axis.zero_moved(settings):
            return f"{moved}; write {axis.joint.homing_counts} there again, or `trade calibrate` it"
        try:
            self.check_settings(axis, settings, axis.name)
        except ConfigurationError as wrong:
            return wrong.problem
        return ""

    # --- a joint that missed an exchange may have restarted without torque: it gets no goal until that is read

    def can_take_goals(self, axes: Sequence[_Servo]) -> bool:
        return not any(axis.in_doubt for axis in axes)

    def making_way(self, job: Motion[_Servo]) -> Steps:
        while not self.can_take_goals(job.devices):
            for axis in job.devices:
                self.require_answering(axis)
            self.idle(_WAIT_S)
            yield

    # --- exchanges of jobs, as steps, within a retry budget

    def looking(self, axis: _Servo) -> Steps:
        yield from self.read_health(axis)

    def read_health(self, axis: ServoAxis[_Health]) -> Generator[None, None, _Health]:
        """Reads the servo's health now."""

        def read() -> _Health:
            asked_ns = self.clock()
            return axis.take_health(self.wire.read(axis.id, *axis.slow).data, asked_ns)

        return (yield from self.retry(axis, read))

    def write_register(self, job: AwaitedJob[_Servo], axis: _Servo, register: Register, value: int) -> Steps:
        """Writes a register and waits for the confirmation."""
        data = register.encode(value)
        yield from self.retry(axis, lambda: self.wire.write(axis.id, register.address, data, job.gate))

    def verify_settings(self, axis: _Servo) -> Steps:
        """Compares a servo with the robot file again, as it may have lost settings or have been replaced.

        Raises:
            DeviceFault: its zero has moved, it is set otherwise, or it cannot hold where it is.
        """
        answer = yield from self.retry(axis, lambda: self.wire.read(axis.id, *axis.settings))
        if problem := self.misfit(axis, answer.data):
            raise axis.fault_error(problem)
        if axis.sample is not None:
            axis.seed(axis.sample.position)

    def retry(self, axis: ServoAxis[Any], act: Callable[[], _Result]) -> Generator[None, None, _Result]:
        """Runs one exchange within the retry budget; a ping before each retry discards late answers."""
        asked, began_ns = False, self.clock()
        for _ in attempts(self.clock, self.stale_after_ns):
            try:
                if asked:
                    self.wire.ping(axis.id)
                    yield
                result = act()
            except DeadlineExceeded as late:
                if asked:  # an earlier attempt was sent, and its outcome is unknown
                    raise OutcomeUnknown(service=late.service, deadline_s=late.deadline_s) from None
                raise
            except NoAnswer:
                asked = axis.doubted = True
                yield
            except RequestRefused as refused:
                raise axis.fault_error(f"it refused a command: {refused}") from None
            else:
                yield
                return result
        waited_s = (self.clock() - began_ns) / 1e9
        raise DeviceSilent(device=axis.name, bus=axis.bus, waited_s=waited_s, reason=self.why_silent())

    # --- from the bus thread

    def cycle(self) -> None:
        """Runs one cycle: stops, gaps, measurements, work, motions, one joint's health."""
        began_ns = self.clock()
        self.serve_stops()
        attended_ns, self._attended_ns = self._attended_ns, self.lasting_clock()
        if self._attended_ns - attended_ns > self.watchdog_ns // 2:
            self._look_after_a_gap()
        self._read()
        self._recover()
        self.work(began_ns + self.period_ns // 2)
        self.watch()
        self._read_due_health()

    def readmit(self, axis: _Servo) -> None:
        """Checks model and health of a joint that was offline or missed an exchange, and settings after the former.

        Never enables or moves it; stops a motion that no client owns.

        Raises:
            NoAnswer: the joint is still offline.
        """
        number = self.wire.ping(axis.id)
        if number != axis.model_number:
            found = self.name_of(number)
            axis.fault = f"another model answers with its id: {found}, not {axis.joint.model}"
            axis.ready = False
            axis.sample = None  # measurements of the original are void: this one gets no commands
            axis.silent = True
            return
        self._refresh_health(axis)
        if axis.silent:
            if problem := self.misfit(axis, self.wire.read(axis.id, *axis.settings).data):
                axis.fault, axis.ready = problem, False
            _log.info("%s answers again", axis.name)
            axis.misses = 0
        axis.silent = axis.doubted = False
        axis.zero.interrupted()
        if axis.motion is None:
            self.stop_found_moving(axis)

    def stop_found_moving(self, axis: _Servo) -> None:
        """Makes a joint hold if it moves and no client owns the motion."""
        if axis.health is not None and axis.health.torque and axis.health.moving:
            asked_ns = self.clock()
            axis.take_sample(self.wire.read(axis.id, *axis.cyclic).data, asked_ns, self.clock())
            self.hold([axis], self.clock())

    # --- parts of a cycle

    def _look_after_a_gap(self) -> None:
        """Checks the joints first after the process was frozen."""
        for axis in self.devices:
            axis.health_due_ns = 0
            if not axis.silent and not axis.doubted and not self._try_health(axis):
                return

    def _read(self) -> None:
        asked = [axis for axis in self.devices if not axis.silent and not axis.doubted]
        if self._size and self.clock() - self._failed_ns > _CLEAN_NS:
            self._size = 0
        size = self.sizes[self._size]
        for at in range(0, len(asked), self._chunk):
            part = asked[at : at + self._chunk]
            asked_ns = self.clock()  # not the arrival, as a frozen process would take old values for new
            silent = {axis.id: axis for axis in part}
            for device_id, answer in self.wire.sync_read(part[0].cyclic[0], size, list(silent)):
                if (axis := silent.pop(device_id, None)) is not None:
                    axis.take_sample(answer.data, asked_ns, self.clock())
                    if answer.alert and not axis.fault:
                        axis.health_due_ns = 0
            for axis in silent.values():
                self.missed(axis)
            self.serve_stops()

    def missed(self, device: _Servo) -> None:
        self._failed_ns = self.clock()
        self._size = (self._size + 1) % len(self.sizes)
        super().missed(device)

    def _recover(self) -> None:
        """Checks joints in doubt, and offline ones when they are due; the first failure ends the round."""
        now_ns = self.clock()
        for axis in self.devices:
            if not axis.in_doubt or now_ns < axis.probe_at_ns:
                continue
            try:
                self.readmit(axis)
            except NoAnswer:
                self.missed(axis)
                return
            except RequestRefused as refused:
                axis.fault, axis.doubted = f"it refuses to be read: {refused}", False
            if axis.silent:
                axis.probe_at_ns = self.clock() + PROBE_NS

    def _read_due_health(self) -> None:
        now_ns = self.clock()
        due = [axis for axis in self.devices if axis.health_due_ns <= now_ns and not axis.silent and not axis.doubted]
        if due:
            self._try_health(min(due, key=lambda axis: axis.health_due_ns))

    def _try_health(self, axis: _Servo) -> bool:
        try:
            self._refresh_health(axis)
        except NoAnswer:
            self.missed(axis)
            return False
        except RequestRefused as refused:
            axis.fault = f"it refuses to be read: {refused}"
        return True

    def _refresh_health(self, axis: _Servo) -> None:
        asked_ns = self.clock()
        axis.take_health(self.wire.read(axis.id, *axis.slow).data, asked_ns)
        axis.health_due_ns = asked_ns + _HEALTH_NS
        self.look_after(axis)
