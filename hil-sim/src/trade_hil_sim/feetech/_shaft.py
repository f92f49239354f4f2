"""The moving part of a servo: which registers send it where, and what its sensors then show.

There is no thread and no integration: a course is planned when a goal is written, and positions are computed from the
clock when they are read.
"""

from typing import Final

from trade_hil_sim.mechanics._profile import Course, at_rest, to_position, to_speed

from ._memory import Memory
from ._table import ACCELERATION_STEPS_S2, CENTRE, COUNTS_PER_TURN, RAD_PER_COUNT

__all__ = ["Shaft"]

QUICK_COUNTS_S2: Final = 200.0 / RAD_PER_COUNT
"""The most the motor accelerates its shaft, 200 rad/s^2: an assumption."""
IN_POSITION_COUNTS: Final = 10
FULL_LOAD: Final = 1000
POSITION_MODE: Final = 0


class Shaft:
    """The shaft of one servo and the controller that turns it.

    Args:
        memory: the servo's registers; read for goals, written with what the sensors show.
        position_counts: where the shaft stands, as register 56 would show it.
        t: now, in seconds.
    """

    def __init__(self, memory: Memory, position_counts: float, t: float) -> None:
        self._memory = memory
        self.course: Course = at_rest(t, position_counts)
        self.jammed = False
        self.temperature_c = 30
        self.supply_v = memory.model.supply_v
        self._shown: float | None = None

    def position(self, t: float) -> float:
        """Where the shaft is, in counts of register 56, unrounded."""
        return self.course.at(t)[0] - self._memory.get("homing_offset")

    def speed(self, t: float) -> float:
        """How fast it turns, in counts/s."""
        return self.course.at(t)[1]

    def moving(self, t: float) -> bool:
        """Whether the shaft turns, or is about to."""
        return t < self.course.ends or self.course.final_speed != 0.0

    def place(self, position_counts: float, t: float) -> None:
        """Put the shaft somewhere, at rest."""
        self.course = at_rest(t, position_counts + self._memory.get("homing_offset"))

    def take_for_centre(self, t: float) -> None:
        """From now on the present position reads 2048: the homing offset makes up for it."""
        shaft = self.course.at(t)[0] % COUNTS_PER_TURN
        self.course = at_rest(t, shaft)
        self._memory.set("homing_offset", max(-2047, min(2047, round(shaft) - CENTRE)))

    def stop(self, t: float) -> None:
        """Come to rest as fast as the motor can."""
        position, speed, _ = self.course.at(t)
        self.course = to_speed(t, position, speed, 0.0, QUICK_COUNTS_S2)

    def follow(self, t: float, share: float) -> None:
        """Set off for the goal, with a share of the motor's torque and speed. In other modes it stands still."""
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
        """Where it goes: the goal position, within the range there is."""
        low, high, goal = (self._memory.get(name) for name in ("min_angle", "max_angle", "goal_position"))
        return goal if low == high == 0 else max(low, min(high, goal))

    def ahead(self, t: float) -> float:
        """How far the goal is, in counts, with the sign of the way."""
        return self.goal() - self.position(t)

    def strains(self, t: float) -> bool:
        """Whether it is held off where it should go."""
        return self.jammed and abs(self.ahead(t)) > IN_POSITION_COUNTS

    def freeze_sensor(self, t: float) -> None:
        """From now on the position register shows what it shows now, whatever the shaft does."""
        self._shown = self.position(t)

    def thaw_sensor(self) -> None:
        """The position register shows the shaft's position again."""
        self._shown = None

    def refresh(self, t: float, *, on: bool) -> None:
        """Write what the sensors show into the table."""
        frozen = self._shown is not None
        for name, value in (
            ("present_position", self._shown if self._shown is not None else self.position(t)),
            ("present_speed", 0 if frozen else self.speed(t)),
            ("present_load", self._effort(t) * FULL_LOAD if on else 0),
            ("present_voltage", self.supply_v * 10),
            ("present_temperature", self.temperature_c),
            ("moving", t < self.course.ends),
        ):
            self._memory.set(name, round(value))

    def _limits(self, share: float) -> tuple[float, float]:
        top, speed = self._memory.model.top_speed_counts_s * share, abs(self._memory.get("goal_speed"))
        acceleration = self._memory.get("acceleration") * ACCELERATION_STEPS_S2
        return min(top, speed or top), min(QUICK_COUNTS_S2, acceleration or QUICK_COUNTS_S2)

    def _effort(self, t: float) -> float:
        """Between -1 and 1: all there is against a jam, else for acceleration and a little for friction."""
        _, speed, acceleration = self.course.at(t)
        if self.strains(t):
            return 1.0 if self.ahead(t) > 0 else -1.0
        friction = 0.05 * ((speed > 0) - (speed < 0))
        return max(-1.0, min(1.0, friction + 0.5 * acceleration / QUICK_COUNTS_S2))
