"""The cyclic exchange with all servos of one bus: stops, measurements, work, goals. One thread calls ``cycle()``."""

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Final, cast

from trade_drivers._exchange import PROBE_NS
from trade_drivers.dynamixel import _jobs as jobs
from trade_drivers.dynamixel import _table as table
from trade_drivers.dynamixel._axis import CYCLIC, SLOW, Health, ServoAxis
from trade_drivers.dynamixel._wire import NoAnswer, Refused
from trade_drivers.joints import Axis, Exchange, Gate, Goal, Job, Steps

if TYPE_CHECKING:
    from trade_drivers.dynamixel._sdk import Wire
    from trade_drivers.robotfile import SerialBus

__all__ = ["ServoExchange"]

_log = logging.getLogger("trade")
_HEALTH_NS: Final = 500_000_000
_CLEAN_NS: Final = 1_000_000_000
_SPANS: Final = tuple(
    register.end - CYCLIC[0]
    for register in (table.PRESENT_POSITION, table.VELOCITY_TRAJECTORY, table.POSITION_TRAJECTORY)
)
"""Sizes of the cyclic read: after a failure the next one is used, so that a late answer has another length."""
_CHUNK_S: Final = 0.014
"""A group is read in pieces that take no longer than this on the wire, so that a stop can come in between."""


class ServoExchange(Exchange):
    """What happens on one bus of servos."""

    def __init__(
        self, wire: "Wire", bus: "SerialBus", axes: Sequence[ServoAxis], clock: Callable[[], int] = time.monotonic_ns
    ) -> None:
        super().__init__(bus, axes, clock)
        self.wire = wire
        self.servos = tuple(axes)
        self.watchdog_counts = max(1, min(127, round(bus.watchdog_s / table.BUS_WATCHDOG.si_per_count)))
        self._fast = bus.fast_sync
        self._gap_ns = int(bus.watchdog_s * 5e8)
        self._chunk = max(1, int(_CHUNK_S * bus.baud / 10 / (12 + CYCLIC[1])))
        self._cycle_ns = clock()
        self._span = 0
        self._failed_ns = 0
        wire.pause = self.pause

    # --- what a servo is told

    def write_goals(self, goals: Mapping[Axis, Goal], gate: Gate) -> None:
        data = {axis.id: jobs.goal_block(goal) for axis, goal in goals.items()}
        self.wire.sync_write(table.PROFILE_ACCELERATION.address, data, gate)

    def write_positions(self, positions: Mapping[Axis, int], gate: Gate) -> None:
        data = {axis.id: table.GOAL_POSITION.encode(position) for axis, position in positions.items()}
        self.wire.sync_write(table.GOAL_POSITION.address, data, gate)

    def write_holds(self, positions: Mapping[Axis, int]) -> None:
        ours: dict[int, bytes] = {}
        others: dict[int, bytes] = {}
        for axis, position in positions.items():
            if axis.ready:  # brakes at its full acceleration, however gentle the move was
                ours[axis.id] = jobs.goal_block(Goal(position, axis.accel_counts, axis.speed_counts))
            else:
                others[axis.id] = table.GOAL_POSITION.encode(position)
        if ours:
            self.wire.sync_write(table.PROFILE_ACCELERATION.address, ours)
        if others:
            self.wire.sync_write(table.GOAL_POSITION.address, others)

    def enabling(self, job: Job, axis: Axis) -> Steps:
        return jobs.enabling(self, job, cast("ServoAxis", axis))

    def relaxing(self, job: Job, axis: Axis) -> Steps:
        return jobs.relaxing(self, job, cast("ServoAxis", axis))

    def looking(self, axis: Axis) -> Steps:
        yield from jobs.read_health(self, cast("ServoAxis", axis))

    def leaving(self, job: Job, axis: Axis, *, relax: bool) -> Steps:
        return jobs.leaving(self, job, cast("ServoAxis", axis), relax=relax)

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
        self.work(began_ns + self.period_ns // 2)
        self.watch()
        self._read_health()

    def readmit(self, axis: ServoAxis) -> None:
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
            self.hold([axis], self.clock())

    def admit(self, axis: ServoAxis) -> None:
        """Take a joint on that was looked over: found enabled, its watchdog is armed; found moving, it is stopped."""
        health = axis.health
        if health is None or not health.torque or health.watchdog == table.WATCHDOG_EXPIRED:
            return
        self.wire.write(axis.id, table.BUS_WATCHDOG.address, table.BUS_WATCHDOG.encode(self.watchdog_counts))
        if health.moving:
            axis.take_sample(self.wire.read(axis.id, *CYCLIC).data, self.clock())
            self.hold([axis], self.clock())

    # --- parts of a cycle

    def _look_after_a_gap(self) -> None:
        """The process was frozen: watchdogs may have expired, so health comes before anything else."""
        for axis in self.servos:
            axis.health_due_ns = 0
            if not axis.silent and not axis.doubted and not self._try_health(axis):
                return

    def _read(self) -> None:
        asked = [axis for axis in self.servos if not axis.silent and not axis.doubted]
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
                    self.missed(axis)
                    continue
                axis.take_sample(answer.data, asked_ns)
                if answer.alert and not axis.fault:
                    axis.health_due_ns = 0
            self.serve_stops()

    def missed(self, device: Axis) -> None:
        self._failed_ns = self.clock()
        self._span = (self._span + 1) % len(_SPANS)
        super().missed(device)

    def _recover(self) -> None:
        """Ping those in doubt, and those long silent when it is their turn; the first that fails ends the round."""
        now_ns = self.clock()
        for axis in self.servos:
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
                self.missed(axis)
                return
            except Refused as refused:
                axis.fault = f"it refuses to be read: {refused}"
            if axis.silent:
                axis.probe_at_ns = self.clock() + PROBE_NS

    def _read_health(self) -> None:
        now_ns = self.clock()
        due = [axis for axis in self.servos if axis.health_due_ns <= now_ns and not axis.silent and not axis.doubted]
        if due:
            self._try_health(min(due, key=lambda axis: axis.health_due_ns))

    def _try_health(self, axis: ServoAxis) -> bool:
        try:
            self._refresh_health(axis)
        except NoAnswer:
            self.missed(axis)
            return False
        except Refused as refused:
            axis.fault = f"it refuses to be read: {refused}"
        return True

    def _refresh_health(self, axis: ServoAxis) -> None:
        asked_ns = self.clock()
        axis.take_health(Health.decode(self.wire.read(axis.id, *SLOW).data, asked_ns))
        axis.health_due_ns = asked_ns + _HEALTH_NS
