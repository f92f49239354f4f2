"""The controller of an axis and the motor it turns: how inputs move it. Turns, turns/s; time is an argument."""

from math import copysign
from typing import Final

from trade_hil_sim.mechanics._shaft import Shaft

from ._table import Command, Control, Input

QUICK: Final = 200.0
"""The most the motor accelerates, in turns/s^2: an assumption."""
COAST: Final = 20.0
"""Deceleration by friction without torque, in turns/s^2: an assumption."""
INERTIA: Final = 0.01
"""Newton metres for one turn/s^2: an assumption."""
AMPERES: Final = 0.2
"""For one turn/s^2: an assumption."""
VELOCITY_LIMIT: Final = 30.0
TRAJECTORY: Final = (2.0, 0.5)
"""Factory speed and acceleration of an ODrive."""
RAMP: Final = 1.0
"""Factory ramp of velocities, in turns/s^2."""


class Motor:
    """One motor.

    Args:
        turns: its position.
        t: the start time.
    """

    def __init__(self, turns: float, t: float) -> None:
        self.shaft = Shaft(turns, t)
        self.goal = turns
        """Its last target."""
        self.zero = 0.0
        """Where its shaft is when it reports 0."""
        self.forget_settings()

    def forget_settings(self) -> None:
        """Reset, as after a restart."""
        self.control, self._input = int(Control.POSITION), int(Input.PASSTHROUGH)
        self._limit = VELOCITY_LIMIT
        self._trajectory_speed, self._trajectory_accel = TRAJECTORY
        self._velocity = self._torque = 0.0

    def amperes(self, t: float) -> float:
        """The current for this acceleration, or against a jam."""
        if self.shaft.jammed and self.shaft.parted:
            return copysign(QUICK * AMPERES, self.shaft.behind(t))
        return self.shaft.actual.at(t)[2] * AMPERES

    # commands

    def command(self, command: Command, values: tuple[float, ...], t: float, *, armed: bool) -> None:
        """Apply settings and inputs."""
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
        """Torque on: it holds its position, unless its input is a speed or a torque."""
        self.goal = self.shaft.position(t) - self.zero
        if self.control != Control.POSITION:
            self._follow(Command.SET_CONTROLLER_MODE, t)

    def coast(self, t: float) -> None:
        """Torque off."""
        self.shaft.forget(t)
        self.shaft.spin(t, 0.0, COAST)

    def _follow(self, command: Command, t: float) -> None:
        if self.control == Control.VELOCITY:
            rate = RAMP if self._input == Input.VEL_RAMP else QUICK
            self.shaft.spin(t, max(-self._limit, min(self._limit, self._velocity)), rate)
        elif self.control == Control.TORQUE:
            pull = copysign(self._limit, self._torque) if self._torque else 0.0
            self.shaft.spin(t, pull, abs(self._torque) / INERTIA or COAST)
        elif self._input != Input.TRAP_TRAJ:
            self.shaft.go(t, self.goal + self.zero, self._limit, QUICK)
        elif command is Command.SET_INPUT_POS:  # a trajectory begins with its goal, not with its mode
            self.shaft.go(t, self.goal + self.zero, self._trajectory_speed, self._trajectory_accel)

    # faults

    def place(self, turns: float, t: float) -> None:
        """Turn it by hand."""
        self.shaft.place(turns + self.zero, t)
        self.shaft.forget(t)

    def jam(self, on: bool, t: float) -> None:
        """Jam the shaft, or release it; a released shaft moves to its target."""
        if on or self.shaft.jammed:
            goal = self.shaft.demand.goal
            self.shaft.jam(on, t)
            if not on and goal is not None and self.shaft.parted:
                self.shaft.go(t, goal, self._trajectory_speed, self._trajectory_accel)
