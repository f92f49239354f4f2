"""The cyclic exchange with all grippers of one bus: stops, measurements, work. One thread calls ``cycle()``."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Final, TypeVar

from trade.errors import MotionStopped, TradeError
from trade_drivers._work import Device, Gate
from trade_drivers.robotiq._hand import Hand
from trade_drivers.robotiq._jobs import Command, Motion, StopTicket
from trade_drivers.robotiq._wire import NoAnswer, Refused

if TYPE_CHECKING:
    from trade_drivers.robotfile import SerialBus
    from trade_drivers.robotiq._modbus import Wire

__all__ = ["Exchange"]

_Job = TypeVar("_Job")

_log = logging.getLogger(__name__)
_RETRIES: Final = 3
_PROBE_NS: Final = 500_000_000
_HALT_NS: Final = 2_000_000_000
_TAKEN_NS: Final = 15_000_000
"""So long after a write the status may still be that of before: the device takes it over 200 times a second."""


class Exchange:
    """What happens on one bus. All but ``submit``, ``stop`` and ``leave`` is for the thread that calls ``cycle``."""

    def __init__(
        self, wire: "Wire", bus: "SerialBus", hands: Sequence[Hand], clock: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self.wire = wire
        self.hands = tuple(hands)
        self.clock = clock
        self.wake = threading.Event()
        self.stale_after_ns = int(bus.stale_after_s * 1e9)
        self.refusing: Callable[[Device], TradeError] | None = None
        self._period_ns = int(1e9 / bus.rate_hz)
        self._inbox: deque[Command] = deque()
        self._stops: deque[StopTicket] = deque()
        self._working: list[Command] = []
        self._stopping: list[StopTicket] = []
        wire.pause = self._pause

    # --- from any thread

    def submit(self, job: Command) -> None:
        """Take work on; the job's ``wait`` tells what became of it."""
        if self.refusing is not None:
            job.finish(self.refusing(job.hand))
        else:
            self._inbox.append(job)

    def stop(self, hands: Sequence[Hand], reason: str = "stop() was called", *, grip: bool = False) -> StopTicket:
        """Void what was admitted for these grippers, and have them stand before anything else happens on the bus."""
        for hand in hands:
            hand.resource.stop("its driver", reason=reason)
        ticket = StopTicket(hands, reason, grip=grip)
        if self.refusing is not None:
            ticket.finish(self.refusing(hands[0]))
        self._stops.append(ticket)
        self.wake.set()
        return ticket

    def leave(self, alive: Callable[[], bool], *, relax: bool) -> None:  # noqa: ARG002 - no robot file here says so
        """Stop what moves; what is held stays held."""
        self.stop(self.hands, "its driver is leaving", grip=True).wait(alive)

    # --- from the bus thread

    def cycle(self) -> None:
        """One round: stops, measurements, work, motions.

        Raises:
            PortLost: the wire is gone.
        """
        began_ns = self.clock()
        for hand in self.hands:
            self.serve_stops()
            self._measure(hand)
        self._work(began_ns + self._period_ns // 2)
        self._watch()

    def idle(self, seconds: float) -> None:
        """Between two cycles; ends early when something came up. Stops do not wait."""
        if self.wake.wait(seconds):
            self.wake.clear()
            self.serve_stops()

    def serve_stops(self) -> None:
        """Write every stop that has come."""
        while self._stops:
            ticket = self._stops.popleft()
            if not ticket.ended:
                self._stopping.append(ticket)
            self._halt(ticket.hands, ticket.reason, grip=ticket.grip)

    def halt_all(self, reason: str) -> None:
        """End every motion; what is held stays held."""
        self._halt(self.hands, reason, grip=True)

    def end_motion(self, hand: Hand, reason: str) -> None:
        """End the motion of a gripper that is about to be reset."""
        if hand.motion is not None:
            self._forget(hand.motion, MotionStopped(device=hand.name, reason=reason))

    def take_over(self, motion: Motion) -> None:
        """A motion's bytes are about to leave: the one it replaces has ended."""
        hand = motion.hand
        if hand.motion not in {None, motion}:
            self.end_motion(hand, "another move took over")
        hand.motion, hand.still, hand.halting_since_ns = motion, 0, 0
        hand.tell_moving()

    def release(self, motion: Motion, error: TradeError | None) -> None:
        """A motion has ended: well, or with an error and its fingers stopped."""
        try:
            if error is not None and motion.hand.motion is motion:
                self._stand(motion.hand)
        finally:
            self._forget(motion, error)

    def fail_all(self, error_of: Callable[[Device], TradeError]) -> None:
        """End everything anyone waits for."""
        for hand in self.hands:
            if hand.motion is not None:
                self._forget(hand.motion, error_of(hand))
        for job in (*self._working, *_drained(self._inbox)):
            job.finish(error_of(job.hand))
        for ticket in (*self._stopping, *_drained(self._stops)):
            ticket.finish(error_of(ticket.hands[0]))
        self._working.clear()
        self._stopping.clear()

    def forget_measurements(self) -> None:
        """The port is gone: nothing is known any more but how long ago it was."""
        now_ns = self.clock()
        for hand in self.hands:
            hand.halting_since_ns = 0
            if not hand.silent:
                hand.silent, hand.silent_since_ns, hand.probe_at_ns = True, now_ns, now_ns

    def admit(self, hand: Hand) -> None:
        """Take a gripper on that was looked over, or is back: found moving and owned by nobody, it is stopped."""
        if hand.sample is not None and hand.sample.under_way and hand.motion is None:
            self._stand(hand)

    # --- exchanges

    def read(self, hand: Hand) -> None:
        """Measure; raises ``NoAnswer``."""
        asked_ns = self.clock()  # not when it came: a frozen process would take old values for new
        self._exchanged(hand, lambda: hand.take(self.wire.read(hand.id), asked_ns))

    def write(self, hand: Hand, values: Sequence[int], gate: Gate | None = None, *, wait: bool = True) -> None:
        """Write, and measure in the same exchange; raises ``NoAnswer``."""
        asked_ns = self.clock()
        self._exchanged(hand, lambda: hand.take(self.wire.write(hand.id, values, gate, wait=wait), asked_ns))

    def probe(self, hand: Hand) -> None:
        """Whether it answers, and nothing late is on its way; raises ``NoAnswer``."""
        self._exchanged(hand, lambda: self.wire.probe(hand.id))
        hand.doubted = False

    def _exchanged(self, hand: Hand, act: Callable[[], object]) -> None:
        try:
            act()
        except NoAnswer:
            self._missed(hand)
            raise

    def _missed(self, hand: Hand) -> None:
        now_ns = self.clock()
        hand.misses += 1
        hand.doubted = True
        if hand.misses >= _RETRIES and not hand.silent:
            _log.warning("%s does not answer on %s", hand.name, hand.bus)
            hand.silent, hand.silent_since_ns = True, now_ns
        if hand.silent:
            hand.probe_at_ns = now_ns + _PROBE_NS * max(1, min(4, hand.misses - _RETRIES + 1))

    def _pause(self, seconds: float) -> None:
        """Keep silent, except for stops; at least those that have come are served before every exchange."""
        self.serve_stops()
        until = time.monotonic() + seconds
        while (left_s := until - time.monotonic()) > 0:
            if self.wake.wait(left_s):
                self.wake.clear()
                self.serve_stops()

    # --- parts of a cycle

    def _measure(self, hand: Hand) -> None:
        if hand.silent and self.clock() < hand.probe_at_ns:
            return
        with suppress(NoAnswer):
            try:
                if hand.doubted or hand.silent:
                    self.probe(hand)
                self.read(hand)
            except Refused as refused:
                hand.fault = f"it is no 2F-85: {refused}"
                return
            if hand.silent:
                _log.info("%s answers again", hand.name)
                hand.silent = False
                self.admit(hand)

    def _work(self, until_ns: int) -> None:
        while self._inbox:
            self._working.append(self._inbox.popleft())
        while self._working and not self._stops:
            taken: set[Hand] = set()
            for job in tuple(self._working):
                if not job.ended and job.hand in taken:
                    continue  # one at a time touches a gripper
                taken.add(job.hand)
                if job.ended or not job.step():
                    self._working.remove(job)
                    job.done_stepping()
                if self._stops:
                    break
            if self.clock() >= until_ns:
                return

    def _watch(self) -> None:
        now_ns = self.clock()
        for hand in self.hands:
            if hand.motion is not None:
                hand.motion.watch(now_ns)
            if hand.halting_since_ns:
                self._watch_halt(hand, now_ns)
            hand.tell_moving()
        for ticket in tuple(self._stopping):
            self._answer(ticket, now_ns)

    def _watch_halt(self, hand: Hand, now_ns: int) -> None:
        if hand.standing(now_ns, self.stale_after_ns):
            hand.halting_since_ns = 0
            return
        sample = hand.sample
        told = sample is not None and (sample.activating or (sample.going and sample.activated))
        seen = sample is not None and sample.at_ns > hand.held_ns + _TAKEN_NS
        if told and seen and now_ns - hand.halting_since_ns <= _HALT_NS:
            self._stand(hand)  # the stop was not heard

    def _answer(self, ticket: StopTicket, now_ns: int) -> None:
        error: TradeError | None = None
        for hand in ticket.hands:
            if hand.silent or hand.age_ns(now_ns) > self.stale_after_ns:
                error = hand.deaf(now_ns)
            elif hand.halting_since_ns and now_ns - hand.halting_since_ns > _HALT_NS:
                error = hand.faulty("told to stop, but it is still moving")
            elif hand.halting_since_ns:
                return
        self._stopping.remove(ticket)
        ticket.finish(error)

    def _halt(self, hands: Iterable[Hand], reason: str, *, grip: bool) -> None:
        for hand in hands:
            now_ns = self.clock()
            quiet = hand.at_rest if grip else hand.standing
            try:
                if not quiet(now_ns, self.stale_after_ns):
                    self._stand(hand)
            finally:
                self.end_motion(hand, reason)

    def _stand(self, hand: Hand) -> None:
        """Write the stop, and watch until it is at rest; whether it was heard is seen later."""
        values = hand.halt_registers()
        now_ns = self.clock()
        hand.still, hand.held_ns = 0, now_ns
        hand.halting_since_ns = hand.halting_since_ns or now_ns
        with suppress(NoAnswer, Refused):
            self.write(hand, values, wait=False)

    def _forget(self, motion: Motion, error: TradeError | None) -> None:
        if motion.hand.motion is motion:
            motion.hand.motion = None
            motion.hand.tell_moving()
        motion.finish(error)


def _drained(queue: "deque[_Job]") -> list[_Job]:
    jobs = list(queue)
    queue.clear()
    return jobs
