"""The cyclic exchange with all grippers of one bus: stops, measurements, work. One thread calls ``cycle()``."""

import logging
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Final

from trade.errors import MotionStopped, TradeError
from trade_drivers.bus._cycle import HALT_NS, BusCycle, StopTicket
from trade_drivers.bus._jobs import Device, Gate, NoAnswer, Refused
from trade_drivers.vendors.robotiq._gripper_state import GripperDevice
from trade_drivers.vendors.robotiq._jobs import Motion

if TYPE_CHECKING:
    from trade_drivers.vendors.robotiq._wire import Wire
    from trade_robotfile import SerialBus

_log = logging.getLogger("trade")
_TAKEN_NS: Final = 15_000_000
"""The time after a write in which the status may be outdated, as the device updates it 200 times a second."""


class Exchange(BusCycle[GripperDevice]):
    """The exchange with the grippers of one bus. Any thread may also call ``stop``."""

    def __init__(
        self, wire: "Wire", bus: "SerialBus", hands: Sequence[GripperDevice], clock: Callable[[], int] | None = None
    ) -> None:
        super().__init__(bus, hands, clock)
        self.wire = wire
        self.hands = tuple(hands)
        wire.pause = self.pause

    # --- from any thread

    def why_silent(self) -> str:
        return self.wire.intruder()

    def stop(
        self, hands: Sequence[GripperDevice], reason: str = "", *, grip: bool = False
    ) -> StopTicket[GripperDevice]:
        """Voids all permits for these grippers, and stops their fingers before anything else happens on the bus.

        With ``grip``, grippers at rest are left as they are, pressing on what they hold.
        """
        reason = reason or self.why(hands)
        return self.order_stop(hands, reason, lambda: self._halt(hands, reason, grip=grip))

    def leave(self, alive: Callable[[], bool], *, relax: bool) -> None:  # noqa: ARG002 - no robot file here says so
        """Stops moving grippers; held objects stay held."""
        self.stop(self.hands, "its driver is leaving", grip=True).wait(alive)

    # --- from the bus thread

    def cycle(self) -> None:
        began_ns = self.clock()
        for hand in self.hands:
            self.serve_stops()
            self._measure(hand)
        self.work(began_ns + self.period_ns // 2)
        self._watch()

    def halt_all(self, reason: str) -> None:
        """Ends all motions; held objects stay held."""
        self._halt(self.hands, reason, grip=True)

    def end_motion(self, hand: GripperDevice, reason: str) -> None:
        """Ends the motion of a gripper before its reset."""
        if hand.motion is not None:
            self._forget(hand.motion, MotionStopped(device=hand.name, reason=reason))

    def take_over(self, motion: Motion) -> None:
        """Ends the previous motion immediately before the bytes of its replacement are sent."""
        hand = motion.hand
        if hand.motion not in {None, motion}:
            self.end_motion(hand, "another move took over")
        hand.motion, hand.still, hand.halting_since_ns = motion, 0, 0
        hand.tell_moving()

    def release(self, motion: Motion, error: TradeError | None) -> None:
        """Completes a motion: successfully, or with an error and stopped fingers."""
        try:
            if error is not None and motion.hand.motion is motion:
                self._stand(motion.hand)
        finally:
            self._forget(motion, error)

    def fail_motion(self, device: GripperDevice, error_of: Callable[[Device], TradeError]) -> None:
        if device.motion is not None:
            self._forget(device.motion, error_of(device))

    def forget_measurements(self) -> None:
        super().forget_measurements()
        for hand in self.hands:
            hand.halting_since_ns = 0

    def admit(self, hand: GripperDevice) -> None:
        """Accepts a checked gripper, and stops a motion that no client owns."""
        if hand.sample is not None and hand.sample.under_way and hand.motion is None:
            self._stand(hand)

    # --- exchanges

    def read(self, hand: GripperDevice) -> None:
        """Measures; raises ``NoAnswer``."""
        asked_ns = self.clock()  # not the arrival, as a frozen process would take old values for new
        self._exchanged(hand, lambda: hand.take(self.wire.read(hand.id), asked_ns))

    def write(self, hand: GripperDevice, values: Sequence[int], gate: Gate | None = None, *, wait: bool = True) -> None:
        """Writes and measures in one exchange; raises ``NoAnswer``."""
        asked_ns = self.clock()
        self._exchanged(hand, lambda: hand.take(self.wire.write(hand.id, values, gate, wait=wait), asked_ns))

    def probe(self, hand: GripperDevice) -> None:
        """Checks that it answers and that no late answer is pending; raises ``NoAnswer``."""
        self._exchanged(hand, lambda: self.wire.probe(hand.id))
        hand.doubted = False

    def _exchanged(self, hand: GripperDevice, act: Callable[[], object]) -> None:
        try:
            act()
        except NoAnswer:
            self.missed(hand)
            raise

    # --- parts of a cycle

    def _measure(self, hand: GripperDevice) -> None:
        if (hand.silent or hand.doubted) and self.clock() < hand.probe_at_ns:
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

    def _watch(self) -> None:
        now_ns = self.clock()
        for hand in self.hands:
            if hand.motion is not None:
                hand.motion.watch(now_ns)
            if hand.halting_since_ns:
                self._watch_halt(hand, now_ns)
            hand.tell_moving()
        self.answer_stops(now_ns)

    def _watch_halt(self, hand: GripperDevice, now_ns: int) -> None:
        if hand.standing(now_ns, self.stale_after_ns):
            hand.halting_since_ns = 0
            return
        sample = hand.sample
        commanded = sample is not None and (sample.activating or (sample.going and sample.activated))
        seen = sample is not None and sample.at_ns > hand.held_ns + _TAKEN_NS
        if commanded and seen and now_ns - hand.halting_since_ns <= HALT_NS:
            self._stand(hand)  # the stop was not received

    def _halt(self, hands: Iterable[GripperDevice], reason: str, *, grip: bool) -> None:
        for hand in hands:
            now_ns = self.clock()
            quiet = hand.at_rest if grip else hand.standing
            try:
                if not quiet(now_ns, self.stale_after_ns):
                    self._stand(hand)
            finally:
                self.end_motion(hand, reason)

    def _stand(self, hand: GripperDevice) -> None:
        """Writes the stop, and watches until it is at rest; later measurements show whether it was received."""
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
