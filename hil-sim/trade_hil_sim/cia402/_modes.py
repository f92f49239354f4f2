"""Modes of operation (CiA 402-2, 9 to 14): how set-points move the shaft, and what the statusword reports."""

from collections.abc import Callable
from enum import IntEnum
from math import inf
from typing import Final

from trade_hil_sim.mechanics._shaft import STILL, Shaft

from ._homing import Homing
from ._store import Store

NEW_SET_POINT: Final = 1 << 4
AT_ONCE: Final = 1 << 5
RELATIVE: Final = 1 << 6
HALT: Final = 1 << 8
REACHED: Final = 1 << 10
LIMITED: Final = 1 << 11
BIT_12: Final = 1 << 12
FULL: Final = 1000
"""Torque is in thousandths."""
MOTION: Final = frozenset({"controlword", "mode", "target_position", "target_velocity", "target_torque"})
"""Objects that could set something moving."""


class Mode(IntEnum):
    """What object 6060h selects."""

    NONE = 0
    PROFILE_POSITION = 1
    PROFILE_VELOCITY = 3
    PROFILE_TORQUE = 4
    HOMING = 6
    CYCLIC_POSITION = 8
    CYCLIC_VELOCITY = 9
    CYCLIC_TORQUE = 10


SET_POINT: Final = {
    Mode.PROFILE_VELOCITY: {"target_velocity"},
    Mode.PROFILE_TORQUE: {"target_torque"},
    Mode.CYCLIC_POSITION: {"target_position", "position_offset"},
    Mode.CYCLIC_VELOCITY: {"target_velocity", "velocity_offset"},
    Mode.CYCLIC_TORQUE: {"target_torque", "torque_offset"},
}
"""Objects that take effect when written; profile position and homing wait for bit 4 of the controlword."""

NO_HALT: Final = frozenset({Mode.CYCLIC_POSITION, Mode.CYCLIC_VELOCITY, Mode.CYCLIC_TORQUE})
"""Bit 8 of the controlword means nothing in these (CiA 402-2, 12 to 14: set-points alone decide)."""


class Modes:
    """Turns set-points into motion while operation is enabled.

    Args:
        store: objects of the drive.
        shaft: what moves.
        counts_per_rev: counts between two index pulses.
        note: puts an event into the log.
    """

    def __init__(
        self, store: Store, shaft: Shaft, counts_per_rev: float, note: Callable[[str, float, str], None]
    ) -> None:
        self._store, self._shaft = store, shaft
        self.mode = Mode.NONE
        self.enabled = False
        self.homing = Homing(store, shaft, counts_per_rev, note)
        self.zero = 0.0
        """Where position 0 is on the shaft; homing moves it."""
        self._acknowledged = False
        self._goal: float | None = None
        self._next: float | None = None
        """A set-point queued behind the present one."""
        self._speed = 0.0
        """The last target speed."""
        self._halted = False
        self._limited = False

    # from the drive

    def select(self, mode: Mode, t: float) -> None:
        """Change the mode and stop any motion, unless the new mode has a set-point that takes effect at once."""
        self.mode = mode
        self._forget()
        if self.enabled:
            self.stop(t, self._store.rate("profile_deceleration"))
            self._follow(t)

    def enable(self, t: float) -> None:
        """Operation is enabled: cyclic and velocity set-points take effect with the values that they have."""
        self.enabled = True
        self._forget()
        self._shaft.forget(t)
        self.stop(t, self._store.rate("profile_deceleration"))
        self._follow(t)

    def disable(self) -> None:
        """Operation is not enabled any more."""
        self.enabled = False
        self._forget()

    def stop(self, t: float, deceleration: float) -> None:
        """Slow down to rest."""
        self._goal = self._next = None
        self._shaft.spin(t, 0.0, deceleration)

    def written(self, names: set[str], before: int, t: float) -> None:
        """Objects have been written; `before` is the previous controlword."""
        if not self.enabled:
            return
        now = self._store.get("controlword")
        self._heed_halt(now, t)
        match self.mode:
            case Mode.PROFILE_POSITION:
                self._handshake(before, now, t)
            case Mode.HOMING:
                self._heed_homing(before, now, t)
            case mode if not self._halted and names & SET_POINT.get(mode, set()):
                self._follow(t)
            case _:
                pass

    @property
    def due(self) -> float:
        """When `advance` should be called."""
        dues = [self.homing.due if self.enabled else inf]
        if self._shaft.settles_at is not None:
            dues.append(self._shaft.settles_at)
        if self._next is not None:
            dues.append(self._shaft.demand.ends)
        return min(dues)

    def next_show(self, t: float) -> float:
        """When the bits may change by themselves after `t`."""
        window_s = self._store.get("position_window_ms") / 1e3
        reached_at = self._shaft.actual.ends + window_s if self._goal is not None else inf
        return min(self._shaft.next_corner(t), reached_at if reached_at > t else inf)

    def advance(self, t: float) -> None:
        """Run what is due."""
        if self._shaft.settles_at is not None and t >= self._shaft.settles_at:
            self._shaft.settle(t, self._top_speed(), self._store.rate("max_acceleration"))
        if self._next is not None and t >= self._shaft.demand.ends:
            self._begin(self._next, t)
            self._next = None
            self._acknowledged = bool(self._store.get("controlword") & NEW_SET_POINT)
        if self.enabled and t >= self.homing.due:
            zero = self.homing.advance(t)
            self.zero = self.zero if zero is None else zero

    def bits(self, t: float) -> int:
        """Bits 10 to 13 of the statusword, which depend on the mode."""
        if not self.enabled:
            return 0
        limited = LIMITED if self._limited else 0
        still = abs(self._shaft.speed(t)) <= STILL and not self._shaft.moving(t)
        match self.mode:
            case Mode.PROFILE_POSITION:
                reached = still if self._halted else self._at_goal(t)
                return limited | (REACHED if reached else 0) | (BIT_12 if self._acknowledged else 0)
            case Mode.PROFILE_VELOCITY:
                reached = still if self._halted else abs(self._shaft.speed(t) - self._speed) < 1
                return limited | (REACHED if reached else 0) | (BIT_12 if still else 0)
            case Mode.HOMING:
                return self.homing.bits
            case Mode.CYCLIC_POSITION | Mode.CYCLIC_VELOCITY | Mode.CYCLIC_TORQUE:
                return limited | BIT_12
            case Mode.PROFILE_TORQUE:
                return limited | REACHED
            case _:
                return 0

    # inside

    def _forget(self) -> None:
        self._acknowledged = self._halted = self._limited = False
        self._goal = self._next = None
        self.homing.forget()

    def _at_goal(self, t: float) -> bool:
        if self._goal is None or self._next is not None:
            return self._goal is None
        near = abs(self._shaft.position(t) - self._goal) <= self._store.get("position_window")
        return near and t >= self._shaft.actual.ends + self._store.get("position_window_ms") / 1e3

    def _heed_halt(self, now: int, t: float) -> None:
        halt = bool(now & HALT)
        if halt == self._halted or self.mode in NO_HALT:
            return
        self._halted = halt
        if halt:
            slow = self._store.get("halt_option") == 1
            rate = self._store.rate("profile_deceleration" if slow else "quick_stop_deceleration")
            self._shaft.spin(t, 0.0, rate)
            self.homing.interrupt(t)
        elif self.mode is Mode.PROFILE_POSITION and self._goal is not None:
            self._begin(self._goal, t)
        else:
            self._follow(t)

    def _handshake(self, before: int, now: int, t: float) -> None:
        """Set-points are taken at the rising edge of bit 4, and only while none is acknowledged (CiA 402-2, 10.2)."""
        if not now & NEW_SET_POINT:
            self._acknowledged = self._next is not None
        elif not before & NEW_SET_POINT and not self._acknowledged and not self._halted:
            self._acknowledged = True
            self._take(now, t)

    def _take(self, now: int, t: float) -> None:
        target = float(self._store.get("target_position"))
        if now & RELATIVE:
            last = self._shaft.position(t) if self._goal is None else self._goal
            target += last - self.zero
        goal = self._within(target)
        if not now & AT_ONCE and self._goal is not None and self._shaft.moving(t):
            self._next = goal
        else:
            self._begin(goal, t)

    def _begin(self, goal: float, t: float) -> None:
        self._goal = goal
        speed = min(self._store.rate("profile_velocity"), self._top_speed())
        self._shaft.go(t, goal, speed, self._store.rate("profile_acceleration"))

    def _heed_homing(self, before: int, now: int, t: float) -> None:
        if now & NEW_SET_POINT and not before & NEW_SET_POINT and not self._halted:
            self.homing.start(t)
        elif before & NEW_SET_POINT and not now & NEW_SET_POINT:
            self.homing.interrupt(t)

    def _follow(self, t: float) -> None:
        """Move to the set-point, in modes whose set-point stays in effect."""
        match self.mode:
            case Mode.PROFILE_VELOCITY:
                self._spin(self._store.rate("target_velocity"), self._store.rate("profile_acceleration"), t)
            case Mode.CYCLIC_VELOCITY:
                wanted = self._store.rate("target_velocity") + self._store.rate("velocity_offset")
                self._spin(wanted, self._store.rate("max_acceleration"), t)
            case Mode.PROFILE_TORQUE:
                self._push(self._store.get("target_torque"), self._store.rate("profile_acceleration"), t)
            case Mode.CYCLIC_TORQUE:
                wanted = self._store.get("target_torque") + self._store.get("torque_offset")
                self._push(wanted, self._store.rate("max_acceleration"), t)
            case Mode.CYCLIC_POSITION:
                goal = self._within(self._store.get("target_position") + self._store.get("position_offset"))
                if goal != self._shaft.demand.goal or self._shaft.parted:
                    acceleration = self._store.rate("max_acceleration")
                    self._shaft.track(t, goal, self._period_s(), self._top_speed(), acceleration)
            case _:
                pass

    def _push(self, torque: int, acceleration: float, t: float) -> None:
        """Turn the shaft against friction: the final speed is proportional to the torque."""
        most = self._store.get("max_torque")
        self._spin(min(most, max(-most, torque)) / FULL * self._top_speed(), acceleration, t)

    def _spin(self, wanted: float, acceleration: float, t: float) -> None:
        """Turn at a speed, but no further than the position limits."""
        top = self._top_speed()
        speed = min(top, max(-top, wanted))
        low, high = self._limits()
        end = high if speed > 0 else low
        self._limited, self._speed = speed != wanted, speed
        if abs(end) == inf or speed == 0:
            self._shaft.spin(t, speed, acceleration)
            return
        here = self._shaft.position(t)
        beyond = here >= end if speed > 0 else here <= end
        self._limited |= beyond
        self._shaft.go(t, here if beyond else end, abs(speed), acceleration)

    def _within(self, target: float) -> float:
        low, high = self._limits()
        goal = min(high, max(low, target + self.zero))
        self._limited = goal != target + self.zero
        return goal

    def _limits(self) -> tuple[float, float]:
        """Position limits on the shaft; none where the objects have their defaults."""
        low, high = self._store.get("position_limit_min"), self._store.get("position_limit_max")
        return (
            -inf if low == -(2**31) else low + self.zero,
            inf if high == 2**31 - 1 else high + self.zero,
        )

    def _top_speed(self) -> float:
        return float(max(1, self._store.rate("max_profile_velocity")))

    def _period_s(self) -> float:
        return self._store.get("interpolation_period") * 10.0 ** self._store.get("interpolation_exponent")
