"""The moving part of a servo: how registers drive it, and what its sensors show."""

from math import inf
from typing import Final

from trade_hil_sim.mechanics._profile import at_rest, to_position, to_speed
from trade_hil_sim.serial._servo import CENTRE, COUNTS_PER_TURN, IN_POSITION_COUNTS, QUICK_COUNTS_S2, ServoShaft

from ._memory import ControlTable
from ._table import ACCELERATION_COUNTS_S2, VELOCITY_COUNTS_S, Mode

PWM_FULL: Final = 885


class Shaft(ServoShaft):
    """The shaft of one servo and the controller that turns it.

    Args:
        table: the servo's registers; read for goals, written with what the sensors show.
        position_counts: the position of the shaft, as register 132 would show it.
        t: now, in seconds.
    """

    def __init__(self, table: ControlTable, position_counts: float, t: float) -> None:
        self._table = table
        self._top = table.model.top_speed_counts_s
        super().__init__(at_rest(t, self._inside(position_counts)))

    @property
    def mode(self) -> Mode:
        """The operating mode in force."""
        return Mode(self._table.get("operating_mode"))

    def position(self, t: float) -> float:
        """Where the shaft is, in counts of register 132, unrounded."""
        return self._flip(self.course.at(t)[0]) + self._table.get("homing_offset")

    def place(self, position_counts: float, t: float) -> None:
        """Put the shaft somewhere, at rest."""
        self.course = at_rest(t, self._inside(position_counts))

    def wrap(self, t: float) -> None:
        """Clear whole turns: the position becomes 0 to 4095."""
        position, speed, _ = self.course.at(t)
        within_a_turn = self._flip(self._flip(position) % COUNTS_PER_TURN)
        self.course = to_speed(t, within_a_turn, speed, 0.0, QUICK_COUNTS_S2)

    def follow(self, t: float) -> None:
        """Start the motion that the goal register of the present mode asks for."""
        position, speed, _ = self.course.at(t)
        if self.jammed:
            self.course = at_rest(t, position)
        elif self.mode.seeks_position:
            goal = self._inside(self._table.get("goal_position"))
            top, acceleration = self._profile(abs(goal - position))
            self.course = to_position(t, position, speed, goal, top, acceleration)
        else:
            self.course = to_speed(t, position, speed, self.direction * self._wanted(), self._ramp())

    def ahead(self, t: float) -> float:
        """How far the goal position is, or how fast it should turn."""
        return self._table.get("goal_position") - self.position(t) if self.mode.seeks_position else self._wanted()

    @property
    def tolerance(self) -> int:
        """The position error that a held shaft may have without overload."""
        return IN_POSITION_COUNTS if self.mode.seeks_position else 0

    def refresh(self, t: float, torque: bool) -> None:
        """Write what the sensors show into the table."""
        table, speed = self._table, self.speed(t)
        shown = self._shown if self._shown is not None else self.position(t)
        counts, units = round(shown), 0 if self._shown is not None else round(speed / VELOCITY_COUNTS_S)
        for name, value in (
            ("present_position", counts),
            ("position_trajectory", round(self.position(t))),
            ("present_velocity", units),
            ("velocity_trajectory", round(speed / VELOCITY_COUNTS_S)),
            ("present_pwm", round(speed / self._top * PWM_FULL) if torque else 0),
            ("moving", int(self._shows_motion(t, units))),
            ("moving_status", self._moving_status(t)),
        ):
            table.set(name, value)
        effort = "present_load" if "present_load" in table.model.by_name else "present_current"
        table.set(effort, round(self._effort(t) * table.model.full_effort_counts) if torque else 0)

    @property
    def direction(self) -> int:
        """-1 in reverse mode."""
        return -1 if self._table.get("drive_mode") & 1 else 1

    def _flip(self, position: float) -> float:
        """Convert between shaft and encoder, either way: reverse mode mirrors about the centre."""
        return 2 * CENTRE - position if self.direction < 0 else position

    def _inside(self, register: float) -> float:
        return self._flip(register - self._table.get("homing_offset"))

    def _wanted(self) -> float:
        match self.mode:
            case Mode.VELOCITY:
                wanted = self._table.get("goal_velocity") * VELOCITY_COUNTS_S
            case Mode.PWM:
                wanted = self._table.get("goal_pwm") / PWM_FULL * self._top
            case _:
                wanted = 0.0  # current control without a load has no speed of its own: not modelled
        return max(-self._top, min(self._top, wanted))

    def _ramp(self) -> float:
        units = self._table.get("profile_acceleration")
        return min(QUICK_COUNTS_S2, units * ACCELERATION_COUNTS_S2 or inf)

    def _profile(self, distance: float) -> tuple[float, float]:
        """Top speed and acceleration for a way of `distance` counts (e-Manual, "What is the Profile")."""
        velocity, acceleration = self._table.get("profile_velocity"), self._ramp()
        if velocity == 0:
            return self._top, QUICK_COUNTS_S2
        if not self._table.get("drive_mode") & 4:
            return min(self._top, velocity * VELOCITY_COUNTS_S), acceleration
        span_s = velocity / 1e3
        ramp_s = max(1e-3, min(self._table.get("profile_acceleration") / 1e3, span_s / 2))
        top = max(distance / (span_s - ramp_s), 1.0)
        return min(self._top, top), min(QUICK_COUNTS_S2, top / ramp_s)

    def _shows_motion(self, t: float, units: int) -> bool:
        profile = self.mode.seeks_position and t < self.course.ends
        return profile or abs(units) > self._table.get("moving_threshold")

    def _moving_status(self, t: float) -> int:
        if not self.mode.seeks_position:
            return 0
        velocity, acceleration = (self._table.get(f"profile_{name}") for name in ("velocity", "acceleration"))
        shape = 0x00 if velocity == 0 else 0x10 if acceleration == 0 else 0x30
        arrived = abs(self._table.get("goal_position") - self.position(t)) <= IN_POSITION_COUNTS
        underway = t < self.course.ends
        return shape | 0x02 * underway | 0x01 * (arrived and not underway) | 0x08 * self.strains(t)
