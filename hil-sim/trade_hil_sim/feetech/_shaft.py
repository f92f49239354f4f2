"""The moving part of a servo: how registers drive it, and what its sensors show."""

from typing import Final

from trade_hil_sim.mechanics._profile import at_rest, to_position
from trade_hil_sim.serial._servo import CENTRE, COUNTS_PER_TURN, QUICK_COUNTS_S2, ServoShaft

from ._memory import MemoryTable
from ._table import ACCELERATION_STEPS_S2

FULL_LOAD: Final = 1000
POSITION_MODE: Final = 0


class Shaft(ServoShaft):
    """The shaft of one servo and the controller that turns it.

    Args:
        memory: the servo's registers; read for goals, written with what the sensors show.
        position_counts: the position of the shaft, as register 56 would show it.
        t: now, in seconds.
    """

    def __init__(self, memory: MemoryTable, position_counts: float, t: float) -> None:
        super().__init__(at_rest(t, position_counts))
        self._memory = memory

    def position(self, t: float) -> float:
        """Where the shaft is, in counts of register 56, unrounded."""
        return self.course.at(t)[0] - self._memory.get("homing_offset")

    def place(self, position_counts: float, t: float) -> None:
        """Put the shaft somewhere, at rest."""
        self.course = at_rest(t, position_counts + self._memory.get("homing_offset"))

    def take_for_centre(self, t: float) -> None:
        """Make the present position read 2048, by changing the homing offset."""
        shaft = self.course.at(t)[0] % COUNTS_PER_TURN
        self.course = at_rest(t, shaft)
        self._memory.set("homing_offset", max(-2047, min(2047, round(shaft) - CENTRE)))

    def follow(self, t: float, share: float) -> None:
        """Start toward the goal with a fraction of the motor's torque and speed. In other modes the shaft rests."""
        position, speed, _ = self.course.at(t)
        if self.jammed:
            self.course = at_rest(t, position)
        elif self._memory.get("mode") != POSITION_MODE:
            self.stop(t)
        else:
            goal = self.goal() + self._memory.get("homing_offset")
            top, acceleration = self._limits(share)
            self.course = to_position(t, position, speed, goal, top, acceleration)

    def goal(self) -> int:
        """Its target: the goal position, limited to the valid range."""
        low, high, goal = (self._memory.get(name) for name in ("min_angle", "max_angle", "goal_position"))
        return goal if low == high == 0 else max(low, min(high, goal))

    def ahead(self, t: float) -> float:
        """The distance to the goal in counts, with its sign."""
        return self.goal() - self.position(t)

    def refresh(self, t: float, *, on: bool) -> None:
        """Write what the sensors show into the table."""
        frozen = self._shown is not None
        for name, value in (
            ("present_position", self._shown if self._shown is not None else self.position(t)),
            ("present_speed", 0 if frozen else self.speed(t)),
            ("present_load", self._effort(t) * FULL_LOAD if on else 0),
            ("moving", t < self.course.ends),
        ):
            self._memory.set(name, round(value))

    def _limits(self, share: float) -> tuple[float, float]:
        top, speed = self._memory.model.top_speed_counts_s * share, abs(self._memory.get("goal_speed"))
        acceleration = self._memory.get("acceleration") * ACCELERATION_STEPS_S2
        return min(top, speed or top), min(QUICK_COUNTS_S2, acceleration or QUICK_COUNTS_S2)
