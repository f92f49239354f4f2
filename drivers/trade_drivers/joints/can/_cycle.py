"""The cyclic exchange with motors that are polled one by one: measurements, work, motions, reconnection."""

import logging
import time
from abc import abstractmethod
from collections.abc import Callable, Generator, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Final, TypeVar

from trade_drivers.bus._jobs import NoAnswer
from trade_drivers.bus.can import Frame, Listeners
from trade_drivers.joints import DeviceUnusable, Exchange, Steps, next_measurement
from trade_drivers.joints.can._axis import MotorAxis
from trade_robotfile import CanBus, Joint

if TYPE_CHECKING:
    from trade_drivers.bus.can import CanPort

_log = logging.getLogger("trade")
_ANSWER_S: Final = 0.25
"""Timeout of one answer: motors take a millisecond, but a busy host takes longer."""
_AGAIN_NS: Final = 1_500_000_000
"""The pause after a missing answer, so that a late one is not taken for the answer to the next request."""
_FIRST: Final = 3
"""Cycles until motion of a motor is detected."""

_Axis = TypeVar("_Axis", bound=MotorAxis)


class MotorExchange(Exchange[_Axis]):
    """The exchange with the motors of one CAN bus."""

    axis_type: ClassVar[Callable[[str, str, Joint, float, Sequence[str]], Any]]
    """Makes the state of a motor: its name, port, table in the robot file, cycles per second, and coupled joints."""
    silent_after_ns: int
    """A motor without any frame for this time is left out."""
    again_ns: ClassVar[int] = _AGAIN_NS
    """The pause before an offline motor is tried again."""

    def __init__(
        self, port: "CanPort", bus: CanBus, axes: Sequence[_Axis], clock: Callable[[], int] | None = None
    ) -> None:
        super().__init__(bus, axes, clock)
        self.port = port
        self.net = Listeners(port, between=self.serve_stops, meanwhile=self.admit)
        self.problems: dict[_Axis, Exception] = {}
        """Why motors were not accepted at their last check."""
        self._verifying: dict[_Axis, Generator[None, None, None]] = {}
        self._began_ns = self._listening_ns = self.clock()
        """The start of the last cycle, and the time since which cycles have been on time."""
        for axis in axes:
            axis.forget(self.clock())
            axis.probe_at_ns = self.clock()

    # --- checks and requests, which depend on the kind of motor

    @staticmethod
    @abstractmethod
    def check_bus(bus: CanBus, axes: Sequence[Any], where: str) -> None:
        """Checks the robot file: keys, limits, and whether a cycle is long enough for its frames.

        Raises:
            ConfigurationError: a check failed; names the key and the right value.
        """

    def question(self, axis: _Axis) -> Frame:
        """Returns the request for a measurement, which also feeds the watchdog."""
        raise NotImplementedError

    def verify(self, axis: _Axis) -> Steps:
        """Checks identity and settings of a motor; yields while it waits for answers. Enables and moves nothing.

        Raises:
            Unfit: the motor cannot be used.
            NoAnswer: the motor does not answer.
        """
        raise NotImplementedError

    def looking(self, axis: _Axis) -> Steps:
        """Waits for a measurement that is requested after this call."""
        self.require_answering(axis)
        yield from next_measurement(self, axis)

    def request(self, axis: _Axis, frames: Sequence[Frame], answered: Callable[[], bool]) -> Steps:
        """Sends a request and waits for the answer.

        Raises:
            NoAnswer: no answer arrived in time.
        """
        self.port.send_all(frames)
        began = time.monotonic()
        while not answered():
            if self.net.heard_until(began + _ANSWER_S):
                raise NoAnswer(axis.id, _ANSWER_S)
            yield

    def look_after(self, axis: _Axis) -> None:
        """Runs further requests and checks of a motor once per cycle."""

    def on_open(self) -> None:
        """Called after the port was first opened and had listened for other drivers."""

    # --- from the bus thread

    def idle(self, seconds: float) -> None:
        self.net.take_in(seconds)

    def why_silent(self) -> str:
        return self.port.doubt

    def serve_stops(self) -> None:
        if self._stops:
            self.port.queue.renew()
        super().serve_stops()

    def cycle(self) -> None:
        """Runs one cycle: stops, measurements, work, motions."""
        began_ns = self.clock()
        if began_ns - self._began_ns > self.stale_after_ns // 2:
            self._listening_ns = began_ns
        self._began_ns = began_ns
        self.net.take_in(0.0)  # a late frame must not answer the next request
        self.measure(began_ns)
        self._listen(began_ns)
        self.after_measuring(began_ns)
        self.admit()
        self.work(began_ns + self.period_ns // 2)
        self.watch()

    def measure(self, began_ns: int) -> None:
        """Requests a measurement from each motor, and processes the answers."""
        here = [axis for axis in self.devices if not axis.silent and not axis.unfed]
        for axis in here:
            axis.asked_ns = began_ns
        if here:
            self.port.send_all([self.question(axis) for axis in here])
        self.net.take_in(self.period_ns / 2e9, lambda: not any(axis.asked_ns for axis in here))
        for axis in here:
            if not axis.silent:
                self.look_after(axis)

    def _listen(self, now_ns: int) -> None:
        """Leaves out motors without a frame for too long; they are tried from time to time."""
        if now_ns - self._listening_ns <= self.stale_after_ns:
            return  # on a busy host, this thread itself was late
        for axis in self.devices:
            old = not axis.unfed and axis.age_ns(now_ns) > self.stale_after_ns
            if not axis.silent and (old or now_ns - axis.beat_ns > self.silent_after_ns):
                axis.why_silent = self.why_silent() or axis.why_silent
                axis.forget(now_ns)
                axis.probe_at_ns = now_ns + self.again_ns

    def after_measuring(self, now_ns: int) -> None:
        """Makes motors hold that were moving when they were accepted, since no client owns that motion.

        A subclass that detects such motion elsewhere may override this method for other work, once per cycle.
        """
        for axis in self.devices:
            if axis.unowned and not axis.silent and now_ns - axis.since_ns > _FIRST * self.period_ns:
                axis.unowned = False
                if axis.motion is None and axis.still == 0 and axis.may_hold_torque:
                    self.hold([axis], now_ns)

    def admit(self) -> None:
        """Continues the checks of offline motors without waiting. An unhealthy process accepts none (S06)."""
        if self.refusing is not None:
            return
        for axis in self.devices:
            if axis.silent and self.clock() >= axis.probe_at_ns and not self.worked_on(axis):
                self._verify(axis)

    def _verify(self, axis: _Axis) -> None:
        steps = self._verifying.setdefault(axis, self.verify(axis))
        try:
            next(steps)
        except StopIteration:
            _log.info("%s answers on %s", axis.name, axis.bus)
            axis.welcome(self.clock())
            self.problems.pop(axis, None)
        except (DeviceUnusable, NoAnswer) as problem:
            self.problems[axis] = problem
            if isinstance(problem, DeviceUnusable):
                axis.fault, axis.ready = str(problem), False  # replaces an earlier fault, as this must be fixed first
            axis.probe_at_ns = self.clock() + _AGAIN_NS
        else:
            return
        del self._verifying[axis]

    def forget_measurements(self) -> None:
        now_ns = self.clock()
        self._verifying.clear()
        for axis in self.devices:
            axis.forget(now_ns)
            axis.probe_at_ns = now_ns
