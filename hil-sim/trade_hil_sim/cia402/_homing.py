"""Homing (CiA 402-2, 11): searching for a switch or an index pulse, and setting zero there."""

from collections.abc import Callable
from math import ceil, floor, inf
from typing import Final

from trade_hil_sim.mechanics._shaft import Shaft

from ._store import Store

METHODS: Final = frozenset({17, 18, 33, 34, 35, 37})
"""Negative and positive limit switch, index pulse in negative and positive direction, here (old and new number)."""
SWITCHES: Final = {17: -200_000.0, 18: 200_000.0}
"""Where the limit switches are on the shaft, in counts."""
HERE: Final = (35, 37)
REACHED: Final = 1 << 10
ATTAINED: Final = 1 << 12
FAILED: Final = 1 << 13


class Homing:
    """One homing procedure at a time.

    Args:
        store: objects of the drive.
        shaft: what moves.
        counts_per_rev: counts between two index pulses.
        note: puts an event into the log.
    """

    def __init__(
        self, store: Store, shaft: Shaft, counts_per_rev: float, note: Callable[[str, float, str], None]
    ) -> None:
        self._store, self._shaft, self._counts_per_rev, self._note = store, shaft, counts_per_rev, note
        self.running = False
        self.bits = REACHED
        """Bits 10, 12 and 13 of the statusword: not started."""

    def forget(self) -> None:
        """Not started."""
        self.running, self.bits = False, REACHED

    def start(self, t: float) -> None:
        """Start to search for what the method names."""
        method = self._store.get("homing_method")
        if method not in METHODS:
            self.bits = FAILED | REACHED
            return
        self.running, self.bits = True, 0
        speed = self._store.rate("homing_switch_speed" if method in SWITCHES else "homing_zero_speed")
        self._shaft.go(t, self._place(method, t), speed, self._store.rate("homing_acceleration"))

    def _place(self, method: int, t: float) -> float:
        here, step = self._shaft.position(t), self._counts_per_rev
        match method:
            case 33:
                return (ceil(here / step) - 1) * step
            case 34:
                return (floor(here / step) + 1) * step
            case _:
                return SWITCHES.get(method, here)

    def interrupt(self, t: float) -> None:
        """Stop the search."""
        if self.running:
            self.forget()
            self._shaft.spin(t, 0.0, self._store.rate("homing_acceleration"))

    @property
    def due(self) -> float:
        """When the search succeeds; never for a jammed shaft."""
        return self._shaft.demand.ends if self.running and not self._shaft.jammed else inf

    def advance(self, t: float) -> float | None:
        """The new zero on the shaft, once the search has succeeded. Home is at minus the home offset."""
        if t < self.due:
            return None
        self.running, self.bits = False, REACHED | ATTAINED
        self._note("homed", t, f"method {self._store.get('homing_method')}")
        return self._shaft.position(t) + self._store.get("home_offset")
