"""The zero of a motor, which a loss of power can shift: each angle is compared with the last known one."""

import threading
from math import ceil, floor, inf, tau
from typing import Final

from trade_drivers.bus._angle_store import Span
from trade_robotfile import Joint

_SLACK_RAD: Final = 0.05
"""How far a joint without power may sag unnoticed, if its encoder loses its zero altogether."""
_FASTEST_RAD_S: Final = 30.0
"""Faster than any joint turns: what is farther between two measurements was no motion."""
_WATCHED: Final = 3
"""After more periods without a measurement, a device may have lost power meanwhile."""
_SAME_RAD: Final = 0.005
"""The precision of a saved angle."""
_AHEAD_S: Final = 0.25
"""How long a moving joint stays within what was saved."""
_NOWHERE: Final[Span] = (inf, -inf)
_LAST: Final = "was last known at"
_ALIAS: Final = "by its place in a turn of its motor, it may as well be in its range at"


class Zero:
    """What is known of the zero of one motor. The bus thread measures; another thread may restore.

    Args:
        joint: its part of the robot file.
        within_turn: whether its encoder keeps its angle within one turn of the motor without power.
    """

    unled_s: float = 0.0
    """How long a moving joint continues by itself after its driver is gone, before it brakes."""

    period_s: float = 0.0
    """The time between two measurements."""

    def __init__(self, joint: Joint, *, within_turn: bool) -> None:
        self._joint, self._within_turn = joint, within_turn
        self._turn_rad = tau / joint.gear
        self._slack_rad = self._turn_rad / 2 if within_turn else _SLACK_RAD
        self._lock = threading.Lock()
        self._angle_rad: float | None = None
        """The newest measurement in which the zero was not in doubt."""
        self._known: Span | None = None
        """Where the joint may have been at the next measurement."""
        self._saved: Span = _NOWHERE
        self._unwatched = True
        self.searching = False
        """True while a homing moves the joint to find its zero."""
        self._other: tuple[str, float] | None = None
        """While the zero is in doubt: the other angle, and where it comes from."""

    def measured(self, angle_rad: float, elapsed_s: float) -> None:
        """Compares a new measurement with the last known angle, ``elapsed_s`` after the last measurement."""
        with self._lock:
            if self.searching or self._joint.zero == "kept":
                return
            self._unwatched |= elapsed_s > _WATCHED * self.period_s
            last_rad = None if self._unwatched else self._angle_rad
            self._other = self._contradiction(angle_rad, elapsed_s)
            if self._other is None:
                self._angle_rad, self._known, self._unwatched = angle_rad, (angle_rad, angle_rad), False
            elif last_rad is not None:
                self._known, self._unwatched = (last_rad, last_rad), True

    def restore(self, known: Span, angle_rad: float) -> None:
        """Compares the present angle with what was saved before the driver was started."""
        with self._lock:
            self._saved = self._known = known
            self._unwatched = True
            if self._joint.zero != "kept":
                self._other = self._contradiction(angle_rad, 0.0)

    def moving(self, speed_rad_s: float) -> None:
        """The joint moves, so that it may be elsewhere at its next measurement."""
        reach_rad = speed_rad_s * self.unled_s + speed_rad_s**2 / (2 * self._joint.max_accel_rad_s2)
        with self._lock:
            if not self._unwatched and (angle_rad := self._angle_rad) is not None:
                self._known = (angle_rad - reach_rad, angle_rad + reach_rad)

    def interrupted(self) -> None:
        """The joint was not watched: it may have lost its power since the last measurement."""
        with self._lock:
            self._unwatched = True

    @property
    def in_doubt(self) -> bool:
        """Whether the newest angle contradicts what is known."""
        return self._other is not None and not self.searching

    def searched(self, *, found: bool) -> None:
        """A homing has ended: if it found the zero, earlier angles count no longer."""
        with self._lock:
            self.searching, self._unwatched = False, True
            if found:
                self._angle_rad = self._known = self._other = None

    def doubt(self, angle_rad: float) -> str:
        """Returns why this angle is not believed; empty if it is."""
        if (other := self._other) is None or self.searching:
            return ""
        source, other_rad = other
        return (
            f"its zero is in doubt, as after a loss of power: it reports {angle_rad:.3f} rad, but {source} "
            f"{other_rad:.3f} rad"
        )

    def to_save(self) -> Span | None:
        """Returns where the joint is if that differs from what is saved, and regards it as saved."""
        with self._lock:
            known = self._known
            if known is None or self._other is not None or self.searching:
                return None
            low, high = known
            margin_rad = 0.0 if low == high else self._joint.max_speed_rad_s * _AHEAD_S
            if margin_rad and self._saved[0] <= low and high <= self._saved[1]:
                return None
            if not margin_rad and max(abs(self._saved[0] - low), abs(self._saved[1] - high)) <= _SAME_RAD:
                return None
            self._saved = (low - margin_rad, high + margin_rad)
            return self._saved

    def unsaved(self) -> None:
        """What was to be saved may be lost: `to_save` returns it again."""
        with self._lock:
            self._saved = _NOWHERE

    def _contradiction(self, angle_rad: float, elapsed_s: float) -> tuple[str, float] | None:
        """Returns the other angle if this one contradicts what is known."""
        if not self._unwatched and self._angle_rad is not None:
            rate = self._joint.max_speed_rad_s if self._within_turn else _FASTEST_RAD_S
            far = abs(angle_rad - self._angle_rad)
            return (_LAST, self._angle_rad) if far > self._slack_rad + rate * max(elapsed_s, self.period_s) else None
        if self._known is not None:
            low, high = self._known
            nearest = max(low, min(high, angle_rad))
            if abs(angle_rad - nearest) >= self._slack_rad:
                return _LAST, nearest
            if high - low < self._slack_rad:
                return None
        return self._alias(angle_rad) if self._within_turn else None

    def _alias(self, angle_rad: float) -> tuple[str, float] | None:
        """Returns an angle inside the range with the same place in a turn of the motor, of one outside."""
        low, high, turn = self._joint.min_rad, self._joint.max_rad, self._turn_rad
        if low <= angle_rad <= high:
            return None
        turns = ceil((low - angle_rad) / turn) if angle_rad < low else floor((high - angle_rad) / turn)
        alias = angle_rad + turns * turn
        return (_ALIAS, alias) if low <= alias <= high else None
