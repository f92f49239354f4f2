"""The cyclic exchange with one controller: stops, measurements, work, the watchdog."""

import logging
import threading
from collections.abc import Callable, Generator
from typing import Any, Final

from trade.errors import MotionStopped, TradeError
from trade_drivers.bus._cycle import HALT_NS, BusCycle, StopTicket
from trade_drivers.bus._gate import Command
from trade_drivers.bus._jobs import Device, PortLost, Steps
from trade_drivers.vendors.ur._arm_state import ArmMotion, ArmStatus
from trade_drivers.vendors.ur._dashboard import tell
from trade_drivers.vendors.ur._link import Child, Link
from trade_drivers.vendors.ur._messages import Disconnected, Done, Halt, Heartbeat, Order, Scale, Servo, TakeControl
from trade_robotfile import UrBus

_log = logging.getLogger("trade")
_BEAT_NS: Final = 20_000_000
_STOPPED_NS: Final = 200_000_000
"""A child that does not answer a stop within this time is killed; then the robot's watchdog stops it (S10)."""
_ANSWER_NS: Final = 1_000_000_000
_TAKEN_NS: Final = 10_000_000_000
_ASK_S: Final = 1.0
_SHOWN_NS: Final = 100_000_000
"""The time after the start of the script until each measurement shows it."""
_SERVO_NS: Final = 50_000_000
"""The delay after which a set-point of a stream is void."""

_ArmCommand = Command[ArmStatus, Any]


class Exchange(BusCycle[ArmStatus]):
    """The exchange with one controller. Any thread may also call ``stop``."""

    def __init__(self, link: Link, bus: UrBus, limb: ArmStatus, clock: Callable[[], int] | None = None) -> None:
        super().__init__(bus, [limb], clock)
        self.link = link
        self.limb = limb
        self.taken = False
        """True while the control script runs, as far as known."""
        self._taken_ns = 0
        self._watchdog_hz = 1 / bus.watchdog_s
        self._beaten_ns = 0
        self._halt_number = 0
        self._halted_ns = 0
        self._ending = False
        """True if the process that commands must be replaced after the stop, as its program was ended."""
        self._stop_sender: threading.Thread | None = None
        """The thread that makes the dashboard end the program."""

    # --- from any thread

    def stop(self, reason: str = "") -> StopTicket[ArmStatus]:
        """Voids all permits, and stops the arm before anything else happens."""
        reason = reason or self.why([self.limb])
        return self.order_stop([self.limb], reason, lambda: self._stop(reason))

    def leave(self, alive: Callable[[], bool], *, relax: bool) -> None:  # noqa: ARG002 - no robot file here says so
        """Stops the arm, which holds, and ends its program."""
        if self.limb.motion is not None or self.limb.still == 0:
            self.stop("its driver is leaving").wait(alive)

    # --- from the bus thread

    def cycle(self) -> None:
        self.listen()
        self.serve_stops()
        self._feed()
        self._step_jobs()
        self._watch()

    def listen(self) -> None:
        """Processes the messages of the child processes.

        Raises:
            PortLost: the reading process has lost the controller.
        """
        states, control = self.link.states, self.link.control
        if states is None or control is None:
            raise PortLost("it is not open")
        try:
            states.listen()
        except Disconnected as gone:
            raise PortLost(f"the connection that states come by was lost: {gone}") from None
        finally:
            for sample in states.samples:
                self.limb.take(sample)
            states.samples.clear()
        try:
            control.listen()
        except Disconnected as gone:
            self.drop_control(f"its control connection was lost: {gone}")

    def halt_all(self, reason: str) -> None:
        """Ends all motions; the process that commands keeps control until its watchdog is no longer fed."""
        self._brake()
        self.end_motion(reason)

    def take_over(self, motion: ArmMotion) -> None:
        """Ends the previous motion immediately before its replacement starts."""
        if self.limb.motion not in {None, motion}:
            self.end_motion("another move took over")
        self.limb.motion, self.limb.still, self.limb.halting_since_ns = motion, 0, 0
        motion.attended_ns = self.lasting_clock()
        self.limb.tell_moving()

    def end_motion(self, reason: str) -> None:
        """Ends the current motion, whose caller gets ``MotionStopped``."""
        if self.limb.motion is not None:
            self._forget(self.limb.motion, MotionStopped(device=self.limb.name, reason=reason))

    def release(self, motion: ArmMotion, error: TradeError | None) -> None:
        """Completes a motion, with or without an error; brakes an ended stream in both cases."""
        if self.limb.motion is motion and (error is not None or motion.streams):
            self._brake()
        self._forget(motion, error)

    def fail_motion(self, device: ArmStatus, error_of: Callable[[Device], TradeError]) -> None:
        if device.motion is not None:
            self._forget(device.motion, error_of(device))

    def forget_measurements(self) -> None:
        super().forget_measurements()
        if self.taken:
            self._end_program()
        self.limb.halting_since_ns = self._halt_number = 0
        self.taken = self._ending = False

    def drop_control(self, reason: str) -> None:
        """Replaces the process that commands by a fresh one; the robot's watchdog stops its motion.

        A program paused by a safeguard stop would resume by itself, so the dashboard ends it, too.
        """
        if self.taken:
            _log.warning("%s: %s; its watchdog stops it", self.limb.name, reason)
            self._end_program()
        self.taken, self._ending, self._halt_number = False, False, 0
        self.link.renew_control()
        if self.limb.motion is not None:
            self.limb.halting_since_ns = self.clock()
            self._forget(self.limb.motion, self.limb.fault_error("" if self.limb.fault else reason))

    # --- orders

    def taking_control(self, job: _ArmCommand) -> Steps:
        """Starts the control script, which stops any other program on the controller."""
        if self.taken:
            return
        until_ns = self.clock() + _TAKEN_NS
        while not self._control.ready or (self._stop_sender is not None and self._stop_sender.is_alive()):
            job.gate()
            if self.clock() > until_ns:
                raise self.limb.fault_error("the process that commands it does not start")
            yield
        hz, step_s = self._watchdog_hz, self.period_ns / 1e9
        done = yield from self._await_reply(
            job, lambda number: TakeControl(number=number, watchdog_hz=hz, step_s=step_s), until_ns
        )
        if done.problem:
            self.drop_control(done.problem)
            raise self.limb.fault_error("" if self.limb.fault else f"control was not granted: {done.problem}")
        self.taken, self._taken_ns = True, self.clock()
        self._feed()

    def making_way(self) -> Steps:
        """Ends the motion, and waits until the arm is at rest."""
        if self.limb.motion is None and not self.limb.halting_since_ns:
            return
        self._brake()
        self.end_motion("another move took over")
        until_ns = self.clock() + HALT_NS
        while self.limb.halting_since_ns:
            if self.clock() > until_ns:
                raise self.limb.fault_error("a stop was sent, but it is still moving")
            yield

    def carrying_out(self, job: _ArmCommand, make: Callable[[int], Order]) -> Generator[None, None, Done]:
        """Sends an order with an immediate answer.

        Raises:
            DeviceFault: the order was refused, or not answered; then the process that commands is replaced.
            DeadlineExceeded: the order arrived too late, and did not run.
        """
        done = yield from self._await_reply(job, make, self.clock() + _ANSWER_NS)
        if done.late:
            raise job.expired()
        if done.problem:
            self.drop_control(done.problem)
            raise self.limb.fault_error("" if self.limb.fault else done.problem)
        return done

    def scaling(self, job: _ArmCommand, fraction: float, expires_ns: int) -> Steps:
        """Sets the speed slider, which needs no control."""
        states = self.link.states
        if states is None:
            raise self.limb.silent_error(self.clock())
        job.gate()
        number, until_ns = states.number(), self.clock() + _ANSWER_NS
        self._tell(states, Scale(number=number, expires_ns=expires_ns, fraction=fraction))
        while (done := states.answer(number)) is None:
            if self.clock() > until_ns:
                raise self.limb.fault_error("the speed slider was not set: no answer")
            yield
        if done.late:
            raise job.expired()
        if done.problem:
            raise self.limb.fault_error(f"the speed slider was not set: {done.problem}")

    def stream(self, positions: list[float]) -> None:
        """Sends one set-point of a stream."""
        self._tell(self._control, Servo(expires_ns=self.clock() + _SERVO_NS, positions=positions))

    @property
    def _control(self) -> Child:
        if self.link.control is None:
            raise self.limb.silent_error(self.clock())
        return self.link.control

    def _await_reply(
        self, job: _ArmCommand, make: Callable[[int], Order], until_ns: int
    ) -> Generator[None, None, Done]:
        control = self._control
        job.gate()
        number = control.number()
        self._tell(control, make(number))
        while (done := control.answer(number)) is None:
            if control is not self.link.control:
                job.gate()  # raises if a stop is the cause
                raise self.limb.fault_error("the process that commands it has ended")
            if self.clock() > until_ns:
                self.drop_control("the process that commands it is stuck")
                raise self.limb.fault_error("the process that commands it was stuck, and was replaced")
            yield
        return done

    def _tell(self, child: Child, order: Order) -> None:
        try:
            child.send(order)
        except Disconnected as gone:
            if child is self.link.control:
                self.drop_control(f"the process that commands it is gone: {gone}")
            raise self.limb.fault_error(f"the command could not be sent: {gone}") from None

    # --- parts of a cycle

    def _feed(self) -> None:
        now_ns = self.clock()
        if self.taken and now_ns - self._beaten_ns >= _BEAT_NS:
            self._beaten_ns = now_ns
            try:
                self._control.send(Heartbeat())
            except Disconnected as gone:
                self.drop_control(f"the process that commands it is gone: {gone}")

    def _step_jobs(self) -> None:
        """Runs one step of each job; more would only wait for answers."""
        while self._inbox:
            self._working.append(self._inbox.popleft())
        for job in tuple(self._working[:1]):
            if job.ended or not job.step():
                self._working.remove(job)
                job.done_stepping()

    def _watch(self) -> None:
        now_ns = self.clock()
        limb = self.limb
        if self._halt_number:
            self._watch_halt(now_ns)
        if limb.motion is not None:
            limb.motion.watch(now_ns)
        if self.taken and not self._halt_number and limb.ended_since(self._taken_ns + _SHOWN_NS):
            self.drop_control("its program was ended")
        if limb.halting_since_ns and limb.at_rest(now_ns, self.stale_after_ns):
            limb.halting_since_ns = 0
        limb.tell_moving()
        self.answer_stops(now_ns)

    def _watch_halt(self, now_ns: int) -> None:
        done = self._control.answer(self._halt_number)
        if done is None and now_ns - self._halted_ns <= _STOPPED_NS:
            return
        self._halt_number = 0
        if done is None or done.problem:
            self.drop_control("a stop was not answered" if done is None else done.problem)
        elif self._ending:
            self.taken = self._ending = False
            self.link.renew_control()

    def _stop(self, reason: str) -> None:
        """Sends the stop to the child; the dashboard gets it separately (S10)."""
        self._brake()
        self._ending = self.taken
        if not self.taken:
            self.link.renew_control()  # it may be about to take control
        self.end_motion(reason)

    def _brake(self) -> None:
        limb, now_ns = self.limb, self.clock()
        limb.still, limb.halting_since_ns = 0, limb.halting_since_ns or now_ns
        if self.taken and not self._halt_number:
            self._halt_number, self._halted_ns = self._control.number(), now_ns
            try:
                self._control.send(Halt(number=self._halt_number, decel=limb.arm.max_accel_rad_s2))
            except Disconnected as gone:
                self.drop_control(f"the process that commands it is gone: {gone}")

    def _end_program(self) -> None:
        self._stop_sender = tell(self.link.path, "stop", _ASK_S)

    def _forget(self, motion: ArmMotion, error: TradeError | None) -> None:
        if self.limb.motion is motion:
            self.limb.motion = None
            self.limb.tell_moving()
        motion.finish(error)
