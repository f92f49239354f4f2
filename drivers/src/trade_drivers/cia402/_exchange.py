"""The cyclic exchange with all drives of one CAN bus: heartbeat, SYNC, measurements, handshakes, work."""

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Final, cast

from trade_drivers._exchange import PROBE_NS
from trade_drivers.cia402 import _jobs as jobs
from trade_drivers.cia402 import _machine as machine
from trade_drivers.cia402 import _table as table
from trade_drivers.cia402._admission import Admission
from trade_drivers.cia402._attach import heartbeat_ms
from trade_drivers.cia402._axis import DriveAxis, Stage
from trade_drivers.cia402._machine import State
from trade_drivers.cia402._net import Net
from trade_drivers.joints import Axis, Exchange, Gate, Goal, Job, Steps

if TYPE_CHECKING:
    from trade_drivers.can import CanPort
    from trade_drivers.robotfile import CanBus

__all__ = ["DriveExchange"]

_log = logging.getLogger("trade")
_BEATS_MISSED: Final = 3


class DriveExchange(Exchange):
    """What happens on one bus of drives."""

    cycles_a_goal = 3
    """Raised, acknowledged, taken back."""

    def __init__(
        self, port: "CanPort", bus: "CanBus", axes: Sequence[DriveAxis], clock: Callable[[], int] = time.monotonic_ns
    ) -> None:
        super().__init__(bus, axes, clock)
        self.port = port
        self.drives = tuple(axes)
        self.net = Net(port, between=self.serve_stops, meanwhile=self._admit)
        self.admissions = tuple(Admission(self, axis, bus) for axis in axes)
        self._beat_ns = int(bus.watchdog_s * 1e9 / 5)
        self._beaten_ns = 0
        self._began_ns = self._listening_ns = clock()
        """When the last cycle began, and since when they have followed each other in time."""
        self.deaf_ns = _BEATS_MISSED * heartbeat_ms(bus) * 1_000_000
        """A drive whose heartbeat has not come for so long is left out."""
        self.rival = False
        """Somebody else sends heartbeats as this driver does."""
        self.net.hear(table.HEARTBEAT + table.OUR_NODE, self._hear_rival)
        for axis in axes:
            axis.forget(clock())
            self._listen_to(axis)

    def _hear_rival(self, _: bytes) -> None:
        if not self.rival:
            _log.error("%s: another driver commands the drives of this bus, too", self.port.path)
        self.rival = True

    def _listen_to(self, axis: DriveAxis) -> None:
        self.net.hear(table.STATUS.base + axis.id, axis.take_status)
        self.net.hear(table.MOTION.base + axis.id, axis.take_motion)
        self.net.hear(table.EMERGENCY + axis.id, axis.take_emergency)
        self.net.hear(table.HEARTBEAT + axis.id, lambda data: axis.take_heartbeat(data, self.clock()))

    # --- what a drive is told

    def command(self, axis: DriveAxis, controlword: int, target: int | None = None) -> None:
        """A controlword, and where to go with it."""
        axis.controlword = controlword
        axis.target = axis.target if target is None else target
        self.port.send(table.COMMAND.base + axis.id, table.COMMAND.layout.pack(controlword, axis.target))

    def write_goals(self, goals: Mapping[Axis, Goal], gate: Gate) -> None:
        """Ramps first, which move nothing; then the gate, and all joints start in one go."""
        for axis, goal in goals.items():
            self.port.send(table.PROFILE.base + axis.id, table.PROFILE.layout.pack(goal.speed, goal.accel))
            self.port.send(table.BRAKING.base + axis.id, table.BRAKING.layout.pack(goal.accel))
        self.write_positions({axis: goal.position for axis, goal in goals.items()}, gate)

    def write_positions(self, positions: Mapping[Axis, int], gate: Gate) -> None:
        gate()
        for axis, position in positions.items():
            drive = cast("DriveAxis", axis)
            drive.asked_ns = self.clock()
            self.command(drive, machine.GO, position)

    def can_take_goals(self, axes: Sequence[Axis]) -> bool:
        return all(cast("DriveAxis", axis).can_take_goal and not self.worked_on(axis) for axis in axes)

    def write_holds(self, positions: Mapping[Axis, int]) -> None:
        """Halt, on the joint's own ramp; what is not known to be enabled is not told, lest that enable it."""
        for axis, position in positions.items():
            drive = cast("DriveAxis", axis)
            drive.asked_ns = 0
            if drive.state_now is State.ENABLED:
                self.port.send(table.BRAKING.base + axis.id, table.BRAKING.layout.pack(axis.accel_counts))
                self.command(drive, machine.HOLD, position)

    def enabling(self, job: Job, axis: Axis) -> Steps:
        return jobs.enabling(self, job, cast("DriveAxis", axis))

    def relaxing(self, job: Job, axis: Axis) -> Steps:
        return jobs.relaxing(self, job, cast("DriveAxis", axis))

    def looking(self, axis: Axis) -> Steps:
        return jobs.looking(self, cast("DriveAxis", axis))

    def making_way(self, axes: Sequence[Axis]) -> Steps:
        for axis in axes:
            drive = cast("DriveAxis", axis)
            yield from jobs.until(self, drive, lambda: drive.can_take_goal, "it does not end its last handshake")  # noqa: B023 - over before the next

    def leaving(self, job: Job, axis: Axis, *, relax: bool) -> Steps:
        return jobs.leaving(self, job, cast("DriveAxis", axis), relax=relax)

    # --- from the bus thread

    def idle(self, seconds: float) -> None:
        self.net.take_in(seconds)

    def cycle(self) -> None:
        """One round: stops, heartbeat, measurements, handshakes, work, motions."""
        began_ns = self.clock()
        if began_ns - self._began_ns > self.stale_after_ns // 2:
            self._listening_ns = began_ns
        self._began_ns = began_ns
        self.net.take_in(0.0)  # what came late is no answer to the next SYNC
        self._beat(began_ns)
        self._measure(began_ns)
        self._listen(began_ns)
        self._shake_hands()
        self._admit()
        self.work(began_ns + self.period_ns // 2)
        self.watch()

    def _beat(self, now_ns: int) -> None:
        """The heartbeat that the drives' own watchdogs live on."""
        if now_ns - self._beaten_ns >= self._beat_ns:
            self._beaten_ns = now_ns
            self.port.send(table.HEARTBEAT + table.OUR_NODE, bytes((table.OPERATIONAL,)))

    def _measure(self, began_ns: int) -> None:
        asked = [axis for axis in self.drives if not axis.silent]
        for axis in self.drives:
            if axis.stage in {Stage.SET_UP, Stage.HERE}:
                axis.awaited_ns = began_ns  # not when it came: a frozen process would take old values for new
        self.port.send(table.SYNC, b"")
        self.net.take_in(self.period_ns / 2e9, lambda: not any(axis.awaited_ns for axis in asked))

    def _listen(self, now_ns: int) -> None:
        """Who has not been heard for too long is left out, and asked now and then whether it is back."""
        if now_ns - self._listening_ns <= self.stale_after_ns:
            return  # on a busy host it was this thread that was silent
        for axis in self.drives:
            if axis.silent:
                continue
            if axis.age_ns(now_ns) > self.stale_after_ns or now_ns - axis.beat_ns > self.deaf_ns:
                _log.warning("%s is not heard on %s", axis.name, axis.bus)
                axis.forget(now_ns)
                axis.probe_at_ns = now_ns + PROBE_NS

    def _shake_hands(self) -> None:
        """A set-point that was taken is taken back, so that the next one has an edge."""
        for axis in self.drives:
            if axis.asked_ns and axis.acknowledged and axis.state_now is State.ENABLED:
                axis.asked_ns = 0
                self.command(axis, axis.controlword & ~machine.NEW_SET_POINT)

    def _admit(self) -> None:
        """Go on with those that are not here; it never waits for them."""
        for admission in self.admissions:
            admission.advance()

    def forget_measurements(self) -> None:
        now_ns = self.clock()
        for axis in self.drives:
            axis.forget(now_ns)
