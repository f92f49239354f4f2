"""A motor and a joint group in memory for tests: they move instantly, and refuse the same commands as real ones."""

import time
from collections.abc import Sequence
from typing import Final

from trade import Resource
from trade_drivers._validation import finite, one_each, valid, within
from trade_drivers.interfaces._motion import JointGroup, Motor, MotorState, Position, Speed, Valid, Velocity
from trade_drivers.motion._plan import JointLimits, Plan
from trade_drivers.testing._fake_device import FakeActuator, end_of, report_whole

_RANGE_RAD: Final = 2.6
_SPEED_RAD_S: Final = 6.0
_LEAST_RAD_S: Final = 1e-4
_ACCEL_RAD_S2: Final = 50.0


class FakeMotor(FakeActuator[float], Motor):
    """A joint that reaches each goal instantly. For tests of behaviours, not of drivers.

    Its services, types, limits and refusals are those of a `Motor`. It has no time and no torque. A velocity turns it
    at once by the angle that it would cover while the velocity is valid, as far as its range allows.
    """

    def __init__(self, name: str, limits: JointLimits | None = None) -> None:
        """A joint at 0 rad or the nearest end of its range, relaxed.

        Args:
            name: its full name, such as ``rosie.neck.pan``.
            limits: by default 2.6 rad to either side, 6 rad/s and 50 rad/s2.
        """
        super().__init__(name, [Resource(name)])
        self._limits = _limits(name) if limits is None else limits
        self._angle = start_rad(self._limits)
        self._enabled = False

    def state(self) -> MotorState:
        """Returns the state, without load; it is at rest unless a test holds a motion up."""
        self._answer()
        return MotorState(
            name=self._name,
            position_rad=self._angle,
            velocity_rad_s=0.0,
            load=0.0,
            temperature_c=None,
            voltage_v=None,
            enabled=self._enabled,
            moving=self._moving,
            fault=self._fault,
            measured_at=time.monotonic(),
            age_s=0.0,
        )

    def limits(self) -> JointLimits:
        """Returns the limits from the constructor."""
        return self._limits

    def move_to(self, position_rad: Position, speed_rad_s: Speed | None = None) -> float:
        """Sets the position, and returns it."""
        goal = finite(position_rad, "move_to", "position_rad")
        self._check_goal(goal)
        checked_speed(speed_rad_s, self._limits, "move_to")
        with self._command("move_to", goal):
            self._go(goal)
        return goal

    def set_velocity(self, velocity_rad_s: Velocity, valid_s: Valid = 0.2) -> None:
        """Turns by the angle that the velocity covers in ``valid_s``."""
        fastest = self._limits.max_speed_rad_s
        velocity = finite(velocity_rad_s, "set_velocity", "velocity_rad_s")
        within(velocity, -fastest, fastest, f"{self._name} speed", "rad/s")
        way_rad = velocity * valid(valid_s, "set_velocity")
        goal = _clamped(self._angle + way_rad, self._limits)
        with self._command("set_velocity", goal):
            self._go(goal)

    def stop(self) -> None:
        """Records the stop; no motion takes time."""
        self._stop()

    def enable(self) -> None:
        """Reports torque as on, and clears a fault."""
        with self._command("enable"):
            self._switch(on=True)

    def relax(self) -> None:
        """Reports torque as off."""
        with self._command("relax"):
            self._switch(on=False)

    def _check_goal(self, goal_rad: float) -> None:
        within(goal_rad, self._limits.min_rad, self._limits.max_rad, self._name, "rad")

    def _go(self, goal_rad: float) -> None:
        self._enabled, self._angle = True, goal_rad

    def _switch(self, *, on: bool) -> None:
        self._enabled = on
        if on:
            self._fault = ""


class FakeJointGroup(FakeActuator[list[float]], JointGroup):
    """Joints that reach each goal instantly. For tests of behaviours, not of drivers.

    Its services, types, limits and refusals are those of a `JointGroup`; locks, stops and e-stops apply to it. It has
    no time and no torque: no motion takes time, so no stop or deadline ends one.
    """

    def __init__(self, joints: Sequence[str], limits: Sequence[JointLimits] | None = None) -> None:
        """Joints at 0 rad or the nearest end of their range, relaxed.

        Args:
            joints: their full names, such as ``rosie.neck.pan``.
            limits: of each joint; by default 2.6 rad to either side, 6 rad/s and 50 rad/s2.
        """
        each = [None] * len(joints) if limits is None else limits
        self.motors = [FakeMotor(joint, limit) for joint, limit in zip(joints, each, strict=True)]
        """The motors of the joints: register them beside the group, or let one of them fail."""
        super().__init__(", ".join(joints), [resource for motor in self.motors for resource in motor.resources])

    def _show(self, *, moving: bool) -> None:
        for motor in self.motors:
            motor._show(moving=moving)

    def joints(self) -> list[str]:
        """Returns the names of the joints."""
        return [motor._name for motor in self.motors]

    def state(self) -> list[MotorState]:
        """Returns the states, without load; they are at rest unless a test holds a motion up."""
        self._answer()
        return [motor.state() for motor in self.motors]

    def limits(self) -> list[JointLimits]:
        """Returns the limits from the constructor."""
        return [motor.limits() for motor in self.motors]

    def move_to(self, positions_rad: list[Position], speed_rad_s: Speed | None = None) -> list[float]:
        """Sets the positions, and returns them."""
        goals = self._checked(positions_rad, "move_to")
        for limits in self.limits():
            checked_speed(speed_rad_s, limits, "move_to")
        return self._go("move_to", goals)

    def servo(self, positions_rad: list[Position], valid_s: Valid = 0.2) -> None:
        """Sets the positions."""
        valid(valid_s, "servo")
        self._go("servo", self._checked(positions_rad, "servo"))

    def stream(self, plan: Plan) -> list[float]:
        """Sets the positions to the end of a trajectory, and reports its whole progress."""
        at_rest = self._go("follow", end_of(plan, [state.position_rad for state in self.state()]))
        report_whole(plan)
        return at_rest

    def stop(self) -> None:
        """Records the stop; no motion takes time."""
        self._stop()

    def enable(self) -> None:
        """Reports torque as on, and clears faults."""
        with self._command("enable"):
            self._switch(on=True)

    def relax(self) -> None:
        """Reports torque as off."""
        with self._command("relax"):
            self._switch(on=False)

    def fail(self, fault: str) -> None:
        """Lets all joints report a fault."""
        for motor in self.motors:
            motor.fail(fault)

    def go_silent(self) -> None:
        """Lets all joints be silent."""
        for motor in self.motors:
            motor.go_silent()

    def recover(self) -> None:
        """Ends the faults and the silence of all joints."""
        for motor in self.motors:
            motor.recover()

    def _answer(self) -> None:
        for motor in self.motors:
            motor._answer()

    def _work(self) -> None:
        for motor in self.motors:
            motor._work()

    def _checked(self, positions_rad: Sequence[float], service: str) -> list[float]:
        goals = one_each(positions_rad, self.joints(), service, "positions_rad")
        for motor, goal in zip(self.motors, goals, strict=True):
            motor._check_goal(goal)
        return goals

    def _go(self, service: str, goals: list[float]) -> list[float]:
        with self._command(service, goals):
            for motor, goal in zip(self.motors, goals, strict=True):
                motor._go(goal)
        return list(goals)

    def _switch(self, *, on: bool) -> None:
        for motor in self.motors:
            motor._switch(on=on)


def checked_speed(speed_rad_s: float | None, limits: JointLimits, service: str) -> None:
    """Raises InvalidArgument or LimitExceeded for a speed that the joint does not have."""
    if speed_rad_s is not None:
        speed = finite(speed_rad_s, service, "speed_rad_s")
        within(speed, _LEAST_RAD_S, limits.max_speed_rad_s, f"{limits.name} speed", "rad/s")


def start_rad(limits: JointLimits) -> float:
    """Returns the angle at which a fake joint begins: the one of its range that is nearest to 0."""
    return _clamped(0.0, limits)


def _clamped(angle_rad: float, limits: JointLimits) -> float:
    return min(limits.max_rad, max(limits.min_rad, angle_rad))


def _limits(joint: str) -> JointLimits:
    return JointLimits(
        name=joint,
        min_rad=-_RANGE_RAD,
        max_rad=_RANGE_RAD,
        max_speed_rad_s=_SPEED_RAD_S,
        max_accel_rad_s2=_ACCEL_RAD_S2,
    )
