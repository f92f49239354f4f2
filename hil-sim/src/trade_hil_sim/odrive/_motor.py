"""The controller of an axis and the motor it turns: which inputs send it where. Turns, turns/s; time is an argument."""

from math import copysign, inf
from typing import Final

from trade_hil_sim.mechanics._shaft import Shaft

from ._table import Command, Control, Input

__all__ = ["Motor"]

QUICK: Final = 200.0
"""The most the motor accelerates, in turns/s^2: an assumption."""
COAST: Final = 20.0
"""What friction slows it down by without torque, in turns/s^2: an assumption."""
INERTIA: Final = 0.01
"""Newton metres for one turn/s^2: an assumption."""
AMPERES: Final = 0.2
"""For one turn/s^2: an assumption."""
VELOCITY_LIMIT: Final = 30.0
TRAJECTORY: Final = (2.0, 0.5)
"""Speed and acceleration as an ODrive comes."""
RAMP: Final = 1.0
"""Of velocities, in turns/s^2, as an ODrive comes."""


class Motor:
    """One motor.

    Args:
        turns: where it is.
        t: since when.
    """

    def __init__(self, turns: float, t: float) -> None:
        self._shaft = Shaft(turns, t)
        self.goal = turns
        """Where it was sent last."""
        self.forget_settings()

    def forget_settings(self) -> None:
        """As after a restart."""
        self.control, self._input = int(Control.POSITION), int(Input.PASSTHROUGH)
        self._limit = VELOCITY_LIMIT
        self._trajectory_speed, self._trajectory_accel = TRAJECTORY
        self._velocity = self._torque = 0.0

    # where it is

    def turns(self, t: float) -> float:
        """Where its shaft is."""
        return self._shaft.position(t)

    def speed(self, t: float) -> float:
        """How fast it turns."""
        return self._shaft.speed(t)

    def moving(self, t: float) -> bool:
        """Whether it turns, or is about to."""
        return self._shaft.moving(t)

    def rests(self, t: float) -> float:
        """When it comes to rest by itself; infinity if it has, or does not."""
        ends = self._shaft.actual.ends
        return ends if ends > t and self._shaft.moving(t) and not self._shaft.actual.final_speed else inf

    def amperes(self, t: float) -> float:
        """What it takes to accelerate it so, or to strain against what holds it."""
        if self._shaft.jammed and self._shaft.parted:
            return copysign(QUICK * AMPERES, self._shaft.behind(t))
        return self._shaft.actual.at(t)[2] * AMPERES

    # what it is told

    def told(self, command: Command, values: tuple[float, ...], t: float, *, armed: bool) -> None:
        """Take settings and inputs."""
        match command:
            case Command.SET_CONTROLLER_MODE:
                self.control, self._input = int(values[0]), int(values[1])
            case Command.SET_INPUT_POS:
                self.goal = values[0]
            case Command.SET_INPUT_VEL:
                self._velocity = values[0]
            case Command.SET_INPUT_TORQUE:
                self._torque = values[0]
            case Command.SET_LIMITS:
                self._limit = values[0]
            case Command.SET_TRAJ_VEL_LIMIT:
                self._trajectory_speed = values[0]
            case Command.SET_TRAJ_ACCEL_LIMITS:
                self._trajectory_accel = min(values)
            case Command.SET_ABSOLUTE_POSITION:
                self.place(values[0], t)
            case _:
                return
        inputs = {Command.SET_CONTROLLER_MODE, Command.SET_INPUT_POS, Command.SET_INPUT_VEL, Command.SET_INPUT_TORQUE}
        if armed and command in inputs:
            self._follow(command, t)

    def arm(self, t: float) -> None:
        """Torque on: it stands where it is, unless its input is a speed or a torque."""
        self.goal = self.turns(t)
        if self.control != Control.POSITION:
            self._follow(Command.SET_CONTROLLER_MODE, t)

    def coast(self, t: float) -> None:
        """Torque off."""
        self._shaft.forget(t)
        self._shaft.spin(t, 0.0, COAST)

    def _follow(self, command: Command, t: float) -> None:
        if self.control == Control.VELOCITY:
            rate = RAMP if self._input == Input.VEL_RAMP else QUICK
            self._shaft.spin(t, max(-self._limit, min(self._limit, self._velocity)), rate)
        elif self.control == Control.TORQUE:
            pull = copysign(self._limit, self._torque) if self._torque else 0.0
            self._shaft.spin(t, pull, abs(self._torque) / INERTIA or COAST)
        elif self._input != Input.TRAP_TRAJ:
            self._shaft.go(t, self.goal, self._limit, QUICK)
        elif command is Command.SET_INPUT_POS:  # a trajectory begins with its goal, not with its mode
            self._shaft.go(t, self.goal, self._trajectory_speed, self._trajectory_accel)

    # what is done to it

    def place(self, turns: float, t: float) -> None:
        """Turn it by hand."""
        self._shaft.place(turns, t)
        self._shaft.forget(t)

    def jam(self, on: bool, t: float) -> None:
        """Hold it fast, or let go of it: then it makes for where it should be."""
        if on or self._shaft.jammed:
            goal = self._shaft.demand.goal
            self._shaft.jam(on, t)
            if not on and goal is not None and self._shaft.parted:
                self._shaft.go(t, goal, self._trajectory_speed, self._trajectory_accel)
