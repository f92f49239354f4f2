"""The exchange with all grippers of one bus, and its commands: activation, moves, and clearing faults.

One thread calls ``cycle()``: stops, measurements, work.
"""

import logging
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Final

from trade.errors import DeadlineExceeded, DeviceSilent, MotionStopped, OutcomeUnknown, TradeError
from trade_drivers.bus._attempts import attempts
from trade_drivers.bus._cycle import HALT_NS, BusCycle, StopTicket
from trade_drivers.bus._gate import Command, Terms
from trade_drivers.bus._jobs import Device, Gate, NoAnswer, RequestRefused, Steps
from trade_drivers.vendors.robotiq import _table as table
from trade_drivers.vendors.robotiq._gripper import GripperDevice, GripperMotion
from trade_drivers.vendors.robotiq._table import Contact, Status
from trade_robotfile import SerialBus

if TYPE_CHECKING:
    from trade_drivers.vendors.robotiq._wire import Wire

_log = logging.getLogger("trade")
_OUTDATED_NS: Final = 15_000_000
"""The time after a write in which the status may be outdated, as the device updates it 200 times a second."""
_RESET_NS: Final = 1_000_000_000
_TAKEN_NS: Final = 500_000_000
_STUCK_S: Final = 0.5
_ACTIVATION_S: Final = 10.0
_NEAR_COUNTS: Final = 8
_MOST_PER_CYCLE_S: Final = 0.1


class Exchange(BusCycle[GripperDevice]):
    """The exchange with the grippers of one bus. Any thread may also call ``stop``."""

    def __init__(
        self, wire: "Wire", bus: SerialBus, devices: Sequence[GripperDevice], clock: Callable[[], int] | None = None
    ) -> None:
        super().__init__(bus, devices, clock)
        self.wire = wire
        wire.pause = self.pause

    # --- from any thread

    def why_silent(self) -> str:
        return self.wire.intruder()

    def stop(
        self, devices: Sequence[GripperDevice], reason: str = "", *, grip: bool = False
    ) -> StopTicket[GripperDevice]:
        """Voids all permits for these grippers, and stops their fingers before anything else happens on the bus.

        With ``grip``, grippers at rest are left as they are, pressing on what they hold.
        """
        reason = reason or self.why(devices)
        return self.order_stop(devices, reason, lambda: self._halt(devices, reason, grip=grip))

    def leave(self, alive: Callable[[], bool], *, relax: bool) -> None:  # noqa: ARG002 - no robot file here says so
        """Stops moving grippers; held objects stay held."""
        self.stop(self.devices, "its driver is leaving", grip=True).wait(alive)

    # --- from the bus thread

    def cycle(self) -> None:
        began_ns = self.clock()
        for device in self.devices:
            self.serve_stops()
            self._measure(device)
        self.work(began_ns + self.period_ns // 2)
        self._watch()

    def halt_all(self, reason: str) -> None:
        """Ends all motions; held objects stay held."""
        self._halt(self.devices, reason, grip=True)

    def end_motion(self, device: GripperDevice, reason: str) -> None:
        """Ends the motion of a gripper before its reset."""
        if device.motion is not None:
            self._forget(device.motion, MotionStopped(device=device.name, reason=reason))

    def take_over(self, motion: "Motion") -> None:
        """Ends the previous motion immediately before the bytes of its replacement are sent."""
        device = motion.device
        if device.motion not in {None, motion}:
            self.end_motion(device, "another move took over")
        device.motion, device.still, device.halting_since_ns = motion, 0, 0
        device.tell_moving()

    def release(self, motion: "Motion", error: TradeError | None) -> None:
        """Completes a motion: successfully, or with an error and stopped fingers."""
        try:
            if error is not None and motion.device.motion is motion:
                self._stand(motion.device)
        finally:
            self._forget(motion, error)

    def fail_motion(self, device: GripperDevice, error_of: Callable[[Device], TradeError]) -> None:
        if device.motion is not None:
            self._forget(device.motion, error_of(device))

    def forget_measurements(self) -> None:
        super().forget_measurements()
        for device in self.devices:
            device.halting_since_ns = 0

    def admit(self, device: GripperDevice) -> None:
        """Accepts a checked gripper, and stops a motion that no client owns."""
        if device.sample is not None and device.sample.under_way and device.motion is None:
            self._stand(device)

    # --- exchanges

    def read(self, device: GripperDevice) -> None:
        """Measures; raises ``NoAnswer``."""
        asked_ns = self.clock()  # not the arrival, as a frozen process would take old values for new
        self._exchanged(device, lambda: device.take(self.wire.read(device.id), asked_ns))

    def write(
        self, device: GripperDevice, values: Sequence[int], gate: Gate | None = None, *, wait: bool = True
    ) -> None:
        """Writes and measures in one exchange; raises ``NoAnswer``."""
        asked_ns = self.clock()
        self._exchanged(device, lambda: device.take(self.wire.write(device.id, values, gate, wait=wait), asked_ns))

    def probe(self, device: GripperDevice) -> None:
        """Checks that it answers and that no late answer is pending; raises ``NoAnswer``."""
        self._exchanged(device, lambda: self.wire.probe(device.id))
        device.doubted = False

    def retry(self, device: GripperDevice, act: Callable[[], None]) -> Steps:
        """Runs one exchange within the retry budget; a probe before each retry discards late answers."""
        began_ns = self.clock()
        for attempt in attempts(self.clock, self.stale_after_ns):
            try:
                if attempt:
                    self.probe(device)
                    yield
                act()
            except DeadlineExceeded as late:
                if attempt:  # an earlier attempt was sent, and its outcome is unknown
                    raise OutcomeUnknown(service=late.service, deadline_s=late.deadline_s) from None
                raise
            except NoAnswer:
                yield
            except RequestRefused as refused:
                raise device.fault_error(f"it is no 2F-85: {refused}") from None
            else:
                yield
                return
        waited_s = (self.clock() - began_ns) / 1e9
        raise DeviceSilent(device=device.name, bus=device.bus, waited_s=waited_s, reason=self.why_silent())

    def require_answering(self, device: GripperDevice) -> None:
        """Raises ``DeviceSilent`` for a gripper that does not answer."""
        if device.silent:
            raise device.silent_error(self.clock())

    def _exchanged(self, device: GripperDevice, act: Callable[[], object]) -> None:
        try:
            act()
        except NoAnswer:
            self.missed(device)
            raise

    # --- parts of a cycle

    def _measure(self, device: GripperDevice) -> None:
        if (device.silent or device.doubted) and self.clock() < device.probe_at_ns:
            return
        with suppress(NoAnswer):
            try:
                if device.doubted or device.silent:
                    self.probe(device)
                self.read(device)
            except RequestRefused as refused:
                device.fault = f"it is no 2F-85: {refused}"
                return
            if device.silent:
                _log.info("%s answers again", device.name)
                device.silent = False
                self.admit(device)

    def _watch(self) -> None:
        now_ns = self.clock()
        for device in self.devices:
            if device.motion is not None:
                device.motion.watch(now_ns)
            if device.halting_since_ns:
                self._watch_halt(device, now_ns)
            device.tell_moving()
        self.answer_stops(now_ns)

    def _watch_halt(self, device: GripperDevice, now_ns: int) -> None:
        if device.standing(now_ns, self.stale_after_ns):
            device.halting_since_ns = 0
            return
        sample = device.sample
        commanded = sample is not None and (sample.activating or (sample.going and sample.activated))
        seen = sample is not None and sample.at_ns > device.held_ns + _OUTDATED_NS
        if commanded and seen and now_ns - device.halting_since_ns <= HALT_NS:
            self._stand(device)  # the stop was not received

    def _halt(self, devices: Iterable[GripperDevice], reason: str, *, grip: bool) -> None:
        for device in devices:
            now_ns = self.clock()
            quiet = device.at_rest if grip else device.standing
            try:
                if not quiet(now_ns, self.stale_after_ns):
                    self._stand(device)
            finally:
                self.end_motion(device, reason)

    def _stand(self, device: GripperDevice) -> None:
        """Writes the stop, and watches until it is at rest; later measurements show whether it was received."""
        values = device.halt_registers()
        now_ns = self.clock()
        device.still, device.held_ns = 0, now_ns
        device.halting_since_ns = device.halting_since_ns or now_ns
        with suppress(NoAnswer, RequestRefused):
            self.write(device, values, wait=False)

    def _forget(self, motion: GripperMotion, error: TradeError | None) -> None:
        for device in motion.devices:
            if device.motion is motion:
                device.motion = None
                device.tell_moving()
        motion.finish(error)


class GripperCommand(Command[GripperDevice, Exchange]):
    """A command with exchanges within a retry budget."""

    @property
    def device(self) -> GripperDevice:
        """The gripper."""
        return self.devices[0]

    def write(self, values: Sequence[int], *, out: Gate | None = None) -> Steps:
        """Writes the command registers within the retry budget; ``out`` runs immediately before the first bytes."""

        def gate() -> None:
            self.gate()
            if out is not None:
                out()

        yield from self.exchange.retry(self.device, lambda: self.exchange.write(self.device, values, gate))

    def read_status(self) -> Generator[None, None, Status]:
        """Reads the gripper's state now."""
        yield from self.exchange.retry(self.device, lambda: self.exchange.read(self.device))
        return self.device.fresh(self.exchange.clock(), self.exchange.stale_after_ns)

    def reset(self) -> Steps:
        """Clears the activation and the faults; nothing moves."""
        exchange, device = self.exchange, self.device
        self.gate()
        exchange.end_motion(device, f"{self.service} was called")
        yield from self.write(table.RESET)
        until_ns = exchange.clock() + _RESET_NS
        while not (status := (yield from self.read_status())).reset or table.fault_text(status.fault):
            if exchange.clock() > until_ns:
                raise device.fault_error(device.fault or "it was reset, but keeps its activation")
        device.fault = ""


class ClearFault(GripperCommand):
    """Resets the device; nothing moves."""

    def steps(self) -> Steps:
        self.exchange.require_answering(self.device)
        yield from self.reset()


class Motion(GripperMotion, GripperCommand):
    """A command that moves the fingers, and is watched until it ends."""

    def __init__(self, exchange: Exchange, devices: Sequence[GripperDevice], terms: Terms) -> None:
        super().__init__(exchange, devices, terms)
        self._began_ns = self._watched_ns = 0
        self._position = -1
        self._waiting_s = 0.0
        self._patience_s = 0.0

    def launch(self, values: Sequence[int], patience_s: float) -> Steps:
        """Writes the command that moves the fingers, and starts to watch them with its first byte."""
        try:
            yield from self.write(values, out=lambda: self.exchange.take_over(self))
        except TradeError as problem:
            self.exchange.release(self, problem)
            raise
        self.note("wrote goal")
        self._patience_s = patience_s
        self._began_ns = self._watched_ns = self.exchange.clock()

    def done_stepping(self) -> None:
        """Does nothing: the motion is watched until it ends. (It has already ended if it was refused.)"""

    def watch(self, now_ns: int) -> None:
        if not self._began_ns:
            return
        ending = self._trouble(now_ns)
        sample = self.device.sample
        if ending is None and sample is not None and sample.at_ns > self._began_ns:
            if self.arrived(sample):
                self.exchange.release(self, None)
                return
            ending = self.stuck(sample)
        if ending is not None:
            self.exchange.release(self, ending)

    def arrived(self, sample: Status) -> bool:
        """Returns whether it is over."""
        raise NotImplementedError

    def stuck(self, sample: Status) -> TradeError | None:
        """Returns the error that prevents its end. Only time between measurements counts, as the rest is unknown."""
        elapsed_s = min((sample.at_ns - self._watched_ns) / 1e9, _MOST_PER_CYCLE_S)
        self._watched_ns = sample.at_ns
        self._waiting_s = self._waiting_s + elapsed_s if sample.position == self._position else 0.0
        self._position = sample.position
        self._patience_s -= elapsed_s
        if self._patience_s > 0 and self._waiting_s <= _STUCK_S:
            return None
        self.device.fault = "it says that it moves, but its fingers stand: its position sensor may be broken"
        return self.device.fault_error()

    def _trouble(self, now_ns: int) -> TradeError | None:
        device = self.device
        if device.silent or device.age_ns(now_ns) > self.exchange.stale_after_ns:
            return device.silent_error(now_ns)
        if device.fault:
            return device.fault_error()
        if self.until_ns is not None and now_ns >= self.until_ns:
            return MotionStopped(device=device.name, reason="its call reached its deadline", late=True)
        return None


class Activate(Motion):
    """Moves the fingers to find their end stops."""

    def steps(self) -> Steps:
        self.exchange.require_answering(self.device)
        status = yield from self.read_status()
        if status.activated and not self.device.fault:
            self.finish()
            return
        yield from self.reset()
        yield from self.launch(table.ACTIVATE, _ACTIVATION_S)

    def arrived(self, sample: Status) -> bool:
        return sample.activated and self.device.still > 0

    def stuck(self, sample: Status) -> TradeError | None:
        if sample.reset and sample.at_ns - self._began_ns > _TAKEN_NS:
            return self.device.inactive("it did not begin its activation, or lost its power in the middle of it")
        problem = super().stuck(sample)
        if problem is not None:
            self.device.fault = "its activation does not end: something may be in the way of its fingers"
            return self.device.fault_error()
        return None


class Move(Motion):
    """Moves the fingers to a width, or until they meet an object."""

    def __init__(
        self, exchange: Exchange, devices: Sequence[GripperDevice], registers: tuple[int, int, int], terms: Terms
    ) -> None:
        super().__init__(exchange, devices, terms)
        self._registers = registers
        self._goal = registers[1]

    def steps(self) -> Steps:
        device, exchange = self.device, self.exchange
        device.check_usable(exchange.clock(), exchange.stale_after_ns)
        slowest_m_s, _ = device.model.speeds_m_s
        yield from self.launch(self._registers, 1.0 + 2 * device.model.stroke_m / slowest_m_s)
        device.force_counts = self._registers[2] & 0xFF

    def arrived(self, sample: Status) -> bool:
        taken = sample.going and sample.echo == self._goal and sample.activated
        return taken and sample.contact != Contact.MOVING and self.device.still > 0 and not self._elsewhere(sample)

    def _elsewhere(self, sample: Status) -> bool:
        """Returns whether it reports its goal as reached although it is elsewhere."""
        short = abs(sample.position - self.device.model.expected(self._goal))
        return sample.contact == Contact.ARRIVED and short > _NEAR_COUNTS

    def stuck(self, sample: Status) -> TradeError | None:
        if not sample.activated:
            return self.device.inactive("it has lost its activation; did its power fail?")
        if (sample.echo != self._goal or not sample.going) and sample.at_ns - self._began_ns > _TAKEN_NS:
            return self.device.fault_error("it does not take a command")
        return super().stuck(sample)
