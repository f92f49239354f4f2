"""The cyclic exchange with all joints of one bus: stops, measurements, work, goals. One thread calls ``cycle()``."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Final

from trade.errors import MotionStopped, TradeError
from trade_drivers.dynamixel import _table as table
from trade_drivers.dynamixel._axis import CYCLIC, SLOW, Axis, Health
from trade_drivers.dynamixel._jobs import Job, StopTicket
from trade_drivers.dynamixel._motion import Motion
from trade_drivers.dynamixel._wire import NoAnswer, Refused

if TYPE_CHECKING:
    from trade_drivers.dynamixel._sdk import Wire
    from trade_drivers.robotfile import SerialBus

__all__ = ["Exchange"]

_log = logging.getLogger(__name__)
_RETRIES: Final = 3
_PROBE_NS: Final = 500_000_000
_HEALTH_NS: Final = 500_000_000
_HALT_NS: Final = 2_000_000_000
_CLEAN_NS: Final = 1_000_000_000
_SPANS: Final = tuple(
    register.end - CYCLIC[0]
    for register in (table.PRESENT_POSITION, table.VELOCITY_TRAJECTORY, table.POSITION_TRAJECTORY)
)
"""Sizes of the cyclic read: after a failure the next one is used, so that a late answer has another length."""
_CHUNK_S: Final = 0.014
"""A group is read in pieces that take no longer than this on the wire, so that a stop can come in between."""


class Exchange:
    """What happens on one bus. Everything but ``submit`` and ``stop`` belongs to the thread that calls ``cycle()``."""

    def __init__(
        self, wire: "Wire", bus: "SerialBus", axes: Sequence[Axis], clock: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self.wire = wire
        self.axes = tuple(axes)
        self.clock = clock
        self.wake = threading.Event()
        """Set when something should not wait for the next cycle."""
        self.stale_after_ns = int(bus.stale_after_s * 1e9)
        self.watchdog_counts = max(1, min(127, round(bus.watchdog_s / table.BUS_WATCHDOG.si_per_count)))
        self.refusing: Callable[[Axis], TradeError] | None = None
        """Why nothing is taken on at present."""
        self._fast = bus.fast_sync
        self._period_ns = int(1e9 / bus.rate_hz)
        self._gap_ns = int(bus.watchdog_s * 5e8)
        self._chunk = max(1, int(_CHUNK_S * bus.baud / 10 / (12 + CYCLIC[1])))
        self._inbox: deque[Job] = deque()
        self._stops: deque[StopTicket] = deque()
        self._working: list[Job] = []
        self._stopping: list[StopTicket] = []
        self._cycle_ns = clock()
        self._span = 0
        self._failed_ns = 0
        wire.pause = self._pause

    # --- from any thread

    def submit(self, job: Job) -> None:
        """Take work on; the job's ``wait`` tells what became of it."""
        if self.refusing is not None:
            job.finish(self.refusing(job.axes[0]))
        else:
            self._inbox.append(job)

    def stop(self, axes: Sequence[Axis], reason: str = "stop() was called") -> StopTicket:
        """Void what was admitted for these joints, and have them hold before anything else happens on the bus."""
        for axis in axes:
            axis.resource.stop("its driver", reason=reason)
        ticket = StopTicket(self, axes, reason)
        if self.refusing is not None:
            ticket.finish(self.refusing(axes[0]))
        self._stops.append(ticket)
        self.wake.set()
        return ticket

    # --- from the bus thread

    def cycle(self) -> None:
        """One round: stops, gaps, measurements, work, motions, one joint's health."""
        began_ns = self.clock()
        self.serve_stops()
        if began_ns - self._cycle_ns > self._gap_ns:
            self._look_after_a_gap()
        self._cycle_ns = began_ns
        self._read()
        self._recover()
        self._work(began_ns + self._period_ns // 2)
        self._watch()
        self._read_health()

    def serve_stops(self) -> None:
        """Write the hold of every stop that has come."""
        while self._stops:
            ticket = self._stops.popleft()
            if not ticket.ended:
                self._stopping.append(ticket)
            self.halt(ticket.axes, ticket.reason)

    def halt(self, axes: Iterable[Axis], reason: str) -> None:
        """End the motions of these joints, whole groups, and have all of them hold where they are."""
        held = dict.fromkeys(axes)
        for axis in tuple(held):
            if (motion := axis.motion) is not None:
                held.update(dict.fromkeys(motion.axes))
        now_ns = self.clock()
        try:
            self._hold([axis for axis in held if not self._at_rest(axis, now_ns)], now_ns)
        finally:
            for axis in held:
                if axis.motion is not None:
                    self._forget(axis.motion, MotionStopped(device=axis.name, reason=reason))

    def _at_rest(self, axis: Axis, now_ns: int) -> bool:
        """Nothing to stop: no torque, or no motion of ours and seen not to move."""
        idle = axis.motion is None and axis.still >= 2 and axis.age_ns(now_ns) <= self.stale_after_ns
        return idle or not axis.may_hold_torque

    def end_motion(self, axis: Axis, reason: str) -> None:
        """End the motion of a joint that is being relaxed; the other members of its group hold."""
        if (motion := axis.motion) is not None:
            self.halt(motion.axes, reason)

    def release(self, motion: Motion, error: TradeError | None) -> None:
        """A watched motion has ended: well, or with an error and all its joints held."""
        try:
            if error is not None:
                self._hold([axis for axis in motion.axes if axis.may_hold_torque], self.clock())
        finally:
            self._forget(motion, error)

    def take_over(self, motion: Motion) -> None:
        """A motion's goals are out: those it replaces have ended, and what they left behind holds."""
        replaced = dict.fromkeys(axis.motion for axis in motion.axes if axis.motion is not None)
        for axis in motion.axes:
            axis.motion, axis.still, axis.halting_since_ns = motion, 0, 0
            axis.tell_moving()
        for old in replaced:
            left = [axis for axis in old.axes if axis.motion is old]
            self._forget(old, MotionStopped(device=motion.axes[0].name, reason="another move took over"))
            self._hold(left, self.clock())

    def fail_all(self, error_of: Callable[[Axis], TradeError]) -> None:
        """End everything anyone waits for."""
        for axis in self.axes:
            if axis.motion is not None:
                self._forget(axis.motion, error_of(axis))
        for job in (*self._working, *self._drain(self._inbox), *self._stopping, *self._drain(self._stops)):
            job.finish(error_of(job.axes[0]))
        self._working.clear()
        self._stopping.clear()

    def readmit(self, axis: Axis) -> None:
        """Look a joint over that was away: its model, its watchdog, its torque.

        Never enables, never moves; found moving and owned by nobody, it is stopped.

        Raises:
            NoAnswer: it is still away.
        """
        number = self.wire.ping(axis.id)
        if number != axis.model.number:
            other = table.BY_MODEL_NUMBER.get(number)
            axis.fault = f"another model answers with its id: {other.name if other else number}, not {axis.model.name}"
            axis.ready = False
            return
        self._refresh_health(axis)
        if axis.silent:
            _log.info("%s answers again", axis.name)
        axis.silent = axis.doubted = False
        axis.misses = 0
        if axis.health is not None and axis.health.torque and axis.health.moving and axis.motion is None:
            axis.take_sample(self.wire.read(axis.id, *CYCLIC).data, self.clock())
            self._hold([axis], self.clock())

    def admit(self, axis: Axis) -> None:
        """Take a joint on that was looked over: found enabled, its watchdog is armed; found moving, it is stopped."""
        health = axis.health
        if health is None or not health.torque or health.watchdog == table.WATCHDOG_EXPIRED:
            return
        self.wire.write(axis.id, table.BUS_WATCHDOG.address, table.BUS_WATCHDOG.encode(self.watchdog_counts))
        if health.moving:
            axis.take_sample(self.wire.read(axis.id, *CYCLIC).data, self.clock())
            self._hold([axis], self.clock())

    def forget_measurements(self) -> None:
        """The port is gone: nothing is known any more but how long ago it was."""
        now_ns = self.clock()
        for axis in self.axes:
            if not axis.silent:
                axis.silent, axis.silent_since_ns, axis.probe_at_ns = True, now_ns, now_ns

    # --- parts of a cycle

    def _pause(self, seconds: float) -> None:
        """Keep silent, except for stops; at least those that have come are served before every exchange."""
        self.serve_stops()
        until = time.monotonic() + seconds
        while (left_s := until - time.monotonic()) > 0:
            if self.wake.wait(left_s):
                self.wake.clear()
                self.serve_stops()

    def _look_after_a_gap(self) -> None:
        """The process was frozen: watchdogs may have expired, so health comes before anything else."""
        for axis in self.axes:
            axis.health_due_ns = 0
            if not axis.silent and not axis.doubted and not self._try_health(axis):
                return

    def _read(self) -> None:
        asked = [axis for axis in self.axes if not axis.silent and not axis.doubted]
        if self._span and self.clock() - self._failed_ns > _CLEAN_NS:
            self._span = 0
        size = _SPANS[self._span]
        for at in range(0, len(asked), self._chunk):
            part = asked[at : at + self._chunk]
            asked_ns = self.clock()  # not when it came: a frozen process would take old values for new
            answers = self.wire.sync_read(CYCLIC[0], size, [axis.id for axis in part], fast=self._fast)
            for axis in part:
                answer = answers.get(axis.id)
                if answer is None:
                    self._missed(axis)
                    continue
                axis.take_sample(answer.data, asked_ns)
                if answer.alert and not axis.fault:
                    axis.health_due_ns = 0
            self.serve_stops()

    def _missed(self, axis: Axis) -> None:
        now_ns = self._failed_ns = self.clock()
        self._span = (self._span + 1) % len(_SPANS)
        axis.misses += 1
        axis.doubted = True
        if axis.misses >= _RETRIES and not axis.silent:
            _log.warning("%s does not answer on %s", axis.name, axis.bus)
            axis.silent, axis.silent_since_ns = True, now_ns
        if axis.silent:
            axis.probe_at_ns = now_ns + _PROBE_NS * max(1, min(4, axis.misses - _RETRIES + 1))

    def _recover(self) -> None:
        """Ping those in doubt, and those long silent when it is their turn; the first that fails ends the round."""
        now_ns = self.clock()
        for axis in self.axes:
            due = axis.silent and now_ns >= axis.probe_at_ns
            if not due and (axis.silent or not axis.doubted):
                continue
            try:
                if axis.silent:
                    self.readmit(axis)
                else:
                    self.wire.ping(axis.id)
                    axis.doubted = False
            except NoAnswer:
                self._missed(axis)
                return
            except Refused as refused:
                axis.fault = f"it refuses to be read: {refused}"
            if axis.silent:
                axis.probe_at_ns = self.clock() + _PROBE_NS

    def _work(self, until_ns: int) -> None:
        while self._inbox:
            self._working.append(self._inbox.popleft())
        while self._working and not self._stops:
            taken: set[Axis] = set()
            for job in tuple(self._working):
                if not job.ended and not taken.isdisjoint(job.axes):
                    continue  # one at a time touches a joint
                taken.update(job.axes)
                if job.ended or not job.step():
                    self._working.remove(job)
                    job.done_stepping()
                if self._stops:
                    break
            if self.clock() >= until_ns:
                return

    def _watch(self) -> None:
        now_ns = self.clock()
        for motion in dict.fromkeys(axis.motion for axis in self.axes if axis.motion is not None):
            motion.watch(now_ns)
        again: list[Axis] = []
        for axis in self.axes:
            if axis.halting_since_ns:
                self._watch_halt(axis, now_ns, again)
        self._hold(again, now_ns)
        for axis in self.axes:
            axis.tell_moving()
        for ticket in tuple(self._stopping):
            self._answer(ticket, now_ns)

    def _watch_halt(self, axis: Axis, now_ns: int, again: list[Axis]) -> None:
        if axis.still >= 2 or not axis.may_hold_torque or axis.fault:
            axis.halting_since_ns = 0
        elif now_ns - axis.halting_since_ns <= _HALT_NS and axis.moved_since_held:
            again.append(axis)  # it was still on its way: so it need not come back as far

    def _answer(self, ticket: StopTicket, now_ns: int) -> None:
        error: TradeError | None = None
        for axis in ticket.axes:
            if axis.silent or axis.age_ns(now_ns) > self.stale_after_ns:
                error = axis.deaf(now_ns)
            elif axis.halting_since_ns and now_ns - axis.halting_since_ns > _HALT_NS:
                error = axis.faulty("told to hold, but it is still moving")
            elif axis.halting_since_ns:
                return
        self._stopping.remove(ticket)
        ticket.finish(error)

    def _hold(self, axes: Sequence[Axis], now_ns: int) -> None:
        ours: dict[int, bytes] = {}
        others: dict[int, bytes] = {}
        for axis in axes:
            position = axis.hold_counts(now_ns)
            if position is not None and axis.ready:
                ours[axis.id] = axis.goal_block(
                    position
                )  # brakes at its full acceleration, however gentle the move was
            elif position is not None:
                others[axis.id] = table.GOAL_POSITION.encode(position)
            axis.still, axis.held_ns = 0, now_ns
            axis.halting_since_ns = axis.halting_since_ns or now_ns
        if ours:
            self.wire.sync_write(table.PROFILE_ACCELERATION.address, ours)
        if others:
            self.wire.sync_write(table.GOAL_POSITION.address, others)

    def _read_health(self) -> None:
        now_ns = self.clock()
        due = [axis for axis in self.axes if axis.health_due_ns <= now_ns and not axis.silent and not axis.doubted]
        if due:
            self._try_health(min(due, key=lambda axis: axis.health_due_ns))

    def _try_health(self, axis: Axis) -> bool:
        try:
            self._refresh_health(axis)
        except NoAnswer:
            self._missed(axis)
            return False
        except Refused as refused:
            axis.fault = f"it refuses to be read: {refused}"
        return True

    def _refresh_health(self, axis: Axis) -> None:
        asked_ns = self.clock()
        axis.take_health(Health.decode(self.wire.read(axis.id, *SLOW).data, asked_ns))
        axis.health_due_ns = asked_ns + _HEALTH_NS

    def _forget(self, motion: Motion, error: TradeError | None) -> None:
        for axis in motion.axes:
            if axis.motion is motion:
                axis.motion = None
                axis.tell_moving()
        motion.finish(error)

    @staticmethod
    def _drain(queue: "deque[Job] | deque[StopTicket]") -> list[Job]:
        jobs: list[Job] = list(queue)
        queue.clear()
        return jobs
