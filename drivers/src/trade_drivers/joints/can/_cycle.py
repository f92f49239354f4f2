"""The cyclic exchange with motors that are asked one by one: measurements, work, motions, and who is away."""

import logging
import time
from collections.abc import Callable, Generator, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Final, TypeVar

from trade_drivers.bus._cycle import silences
from trade_drivers.bus._jobs import NoAnswer
from trade_drivers.bus.can import Frame, Listeners
from trade_drivers.joints import Exchange, Steps, Unfit
from trade_drivers.joints.can._axis import MotorAxis

if TYPE_CHECKING:
    from trade_drivers.bus.can import CanPort
    from trade_drivers.robotfile import CanBus

__all__ = ["MotorExchange", "asked"]

_log = logging.getLogger("trade")
_ANSWER_S: Final = 0.25
"""Patience for one answer: motors take a millisecond, but a busy host takes its time."""
_AGAIN_NS: Final = 1_500_000_000
"""How long who does not answer is left alone: what comes that late is not taken for an answer to the next question."""
_FIRST: Final = 3
"""Cycles until it is seen whether a motor moves."""

_Axis = TypeVar("_Axis", bound=MotorAxis)


def asked(bus: "MotorExchange[Any]", axis: MotorAxis, frames: Sequence[Frame], there: Callable[[], bool]) -> Steps:
    """Send a question, and wait until the answer is there.

    Raises:
        NoAnswer: it has not come in time.
    """
    bus.port.send_all(frames)
    began = time.monotonic()
    while not there():
        if bus.net.heard_until(began + _ANSWER_S):
            raise NoAnswer(axis.id, _ANSWER_S)
        yield


class MotorExchange(Exchange[_Axis]):
    """What happens on one bus of such motors."""

    deaf_ns: int
    """A motor of which nothing was heard for so long is left out."""
    again_ns: ClassVar[int] = _AGAIN_NS
    """How long a motor that is left out is not asked."""

    def __init__(
        self, port: "CanPort", bus: "CanBus", axes: Sequence[_Axis], clock: Callable[[], int] = time.monotonic_ns
    ) -> None:
        super().__init__(bus, axes, clock)
        self.port = port
        self.net = Listeners(port, between=self.serve_stops, meanwhile=self.admit)
        self.problems: dict[_Axis, Exception] = {}
        """Why those that are away were not taken on when they were last looked over."""
        self._looks: dict[_Axis, Generator[None, None, None]] = {}
        self._began_ns = self._listening_ns = clock()
        """When the last cycle began, and since when they have followed each other in time."""
        for axis in axes:
            axis.forget(clock())
            axis.probe_at_ns = clock()

    # --- what a motor of this kind is asked, and how

    def question(self, axis: _Axis) -> Frame:
        """What makes it tell where it is; feeds its watchdog."""
        raise NotImplementedError

    def look_over(self, axis: _Axis) -> Steps:
        """Find out who it is and whether it is fit; yields while an answer is awaited. Enables and moves nothing.

        Raises:
            Unfit: it cannot be used.
            NoAnswer: it does not answer.
        """
        raise NotImplementedError

    def look_after(self, axis: _Axis) -> None:
        """What else is asked of it, and seen to, once in a cycle."""

    def opened(self) -> None:
        """Its port was opened for the first time, after listening to who talks there."""

    # --- from the bus thread

    def idle(self, seconds: float) -> None:
        self.net.take_in(seconds)

    def cycle(self) -> None:
        """One round: stops, measurements, work, motions."""
        began_ns = self.clock()
        if began_ns - self._began_ns > self.stale_after_ns // 2:
            self._listening_ns = began_ns
        self._began_ns = began_ns
        self.net.take_in(0.0)  # what came late is no answer to the next question
        self.measure(began_ns)
        self._listen(began_ns)
        self.settle(began_ns)
        self.admit()
        self.work(began_ns + self.period_ns // 2)
        self.watch()

    def measure(self, began_ns: int) -> None:
        """Ask every motor where it is, and take in what they say."""
        here = [axis for axis in self.devices if not axis.silent and not axis.hushed]
        for axis in here:
            axis.asked_ns = began_ns
        if here:
            self.port.send_all([self.question(axis) for axis in here])
        self.net.take_in(self.period_ns / 2e9, lambda: not any(axis.asked_ns for axis in here))
        for axis in here:
            if not axis.silent:
                self.look_after(axis)

    def _listen(self, now_ns: int) -> None:
        """Who has not been heard for too long is left out, and looked over now and then whether it is back."""
        if now_ns - self._listening_ns <= self.stale_after_ns:
            return  # on a busy host it was this thread that was silent
        for axis in self.devices:
            old = not axis.hushed and axis.age_ns(now_ns) > self.stale_after_ns
            if not axis.silent and (old or now_ns - axis.beat_ns > self.deaf_ns):
                silences.warning("%s is not heard on %s", axis.name, axis.bus)
                axis.forget(now_ns)
                axis.probe_at_ns = now_ns + self.again_ns

    def settle(self, now_ns: int) -> None:
        """What was moving when it was taken on is told to hold: nobody owns that motion."""
        for axis in self.devices:
            if axis.stranger and not axis.silent and now_ns - axis.since_ns > _FIRST * self.period_ns:
                axis.stranger = False
                if axis.motion is None and axis.still == 0 and axis.may_hold_torque:
                    self.hold([axis], now_ns)

    def admit(self) -> None:
        """Go on with those that are away; it never waits for them. An unhealthy process admits nobody (S06)."""
        if self.refusing is not None:
            return
        for axis in self.devices:
            if axis.silent and self.clock() >= axis.probe_at_ns and not self.worked_on(axis):
                self._look(axis)

    def _look(self, axis: _Axis) -> None:
        look = self._looks.setdefault(axis, self.look_over(axis))
        try:
            next(look)
        except StopIteration:
            _log.info("%s is heard on %s", axis.name, axis.bus)
            axis.welcome(self.clock())
            self.problems.pop(axis, None)
        except (Unfit, NoAnswer) as problem:
            self.problems[axis] = problem
            if isinstance(problem, Unfit):
                axis.fault, axis.ready = str(problem), False  # whatever was wrong before, this has to be mended first
            axis.probe_at_ns = self.clock() + _AGAIN_NS
        else:
            return
        del self._looks[axis]

    def forget_measurements(self) -> None:
        now_ns = self.clock()
        self._looks.clear()
        for axis in self.devices:
            axis.forget(now_ns)
            axis.probe_at_ns = now_ns
