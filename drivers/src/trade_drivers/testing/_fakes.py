"""A joint group in memory for tests: it moves instantly, and refuses the same commands as a real one."""

import math
import time
from collections.abc import Sequence
from typing import Final

from trade import Resource, permit
from trade.errors import ToleranceExceeded
from trade_drivers._validation import one_each, valid, within
from trade_drivers.interfaces._motion import JointGroup, MotorState, Position, Speed, Valid
from trade_drivers.motion._plan import JointLimits, Plan

__all__ = ["FakeJointGroup"]

_RANGE_RAD: Final = 2.6
_SPEED_RAD_S: Final = 6.0
_ACCEL_RAD_S2: Final = 50.0


class FakeJointGroup(JointGroup):
    """Joints that reach each goal instantly. For tests of behaviours, not of drivers.

    Its services, types, limits and refusals are those of a `JointGroup`; locks, stops and e-stops apply to it. It has
    no time and no torque: no motion takes time, so no stop or deadline ends one.
    """

    def __init__(self, joints: Sequence[str], limits: Sequence[JointLimits] | None = None) -> None:
        """Joints at 0 rad, relaxed.

        Args:
            joints: their full names, such as ``rosie.neck.pan``.
            limits: of each joint; by default 2.6 rad to either side, 6 rad/s and 50 rad/s2.
        """
        self.went: list[list[float]] = []
        """Commanded positions in rad, oldest first; for a trajectory, its end."""
        self._joints = list(joints)
        self._limits = [_limits(joint) for joint in joints] if limits is None else list(limits)
        self._resources = tuple(Resource(joint) for joint in joints)
        self._angles = [0.0] * len(self._joints)
        self._enabled = False

    @property
    def resources(self) -> tuple[Resource, ...]:
        """The resources of the joints."""
        return self._resources

    def joints(self) -> list[str]:
        """Returns the names of the joints."""
        return list(self._joints)

    def state(self) -> list[MotorState]:
        """Returns states at rest, without load."""
        now = time.monotonic()
        return [
            MotorState(
                name=joint,
                position_rad=angle,
                velocity_rad_s=0.0,
                load=0.0,
                temperature_c=None,
                voltage_v=None,
                enabled=self._enabled,
                moving=False,
                measured_at=now,
                age_s=0.0,
            )
            for joint, angle in zip(self._joints, self._angles, strict=True)
        ]

    def limits(self) -> list[JointLimits]:
        """Returns the limits from the constructor."""
        return list(self._limits)

    def move_to(self, positions_rad: list[Position], speed_rad_s: Speed | None = None) -> list[float]:
        """Sets the positions, and returns them."""
        goals = self._checked(positions_rad, "move_to")
        if speed_rad_s is not None:
            for limits in self._limits:
                within(speed_rad_s, 0.0, limits.max_speed_rad_s, limits.name, "rad/s")
        return self._go(goals)

    def servo(self, positions_rad: list[Position], valid_s: Valid = 0.2) -> None:
        """Sets the positions."""
        valid(valid_s, "servo")
        self._go(self._checked(positions_rad, "servo"))

    def stream(self, plan: Plan) -> list[float]:
        """Sets the positions to the end of a trajectory, and reports its whole progress."""
        starts, goals = ([curve.at(moment)[0] for _, curve in plan.tracks] for moment in (0.0, math.inf))
        for joint, angle, start in zip(self._joints, self._angles, starts, strict=True):
            if abs(angle - start) > (allowed := plan.tolerances.start_rad):
                error = angle - start
                raise ToleranceExceeded(device=joint, bus="", what="start", error_rad=error, tolerance_rad=allowed)
        at_rest = self._go(goals)
        plan.course.ready(0)
        plan.course.report(math.ceil(plan.course.duration_s * 1e9))
        return at_rest

    def stop(self) -> None:
        """Does nothing but stop the resources, as no motion takes time."""

    def enable(self) -> None:
        """Reports torque as on."""
        self._switch(on=True)

    def relax(self) -> None:
        """Reports torque as off."""
        self._switch(on=False)

    def _checked(self, positions_rad: Sequence[float], service: str) -> list[float]:
        goals = one_each(positions_rad, self._joints, service, "positions_rad")
        for goal, limits in zip(goals, self._limits, strict=True):
            within(goal, limits.min_rad, limits.max_rad, limits.name, "rad")
        return goals

    def _go(self, goals: list[float]) -> list[float]:
        with permit(self._resources) as permitted:
            permitted.gate()
            self._enabled, self._angles = True, goals
            self.went.append(list(goals))
        return list(goals)

    def _switch(self, *, on: bool) -> None:
        with permit(self._resources) as permitted:
            permitted.gate()
            self._enabled = on


def _limits(joint: str) -> JointLimits:
    return JointLimits(
        name=joint,
        min_rad=-_RANGE_RAD,
        max_rad=_RANGE_RAD,
        max_speed_rad_s=_SPEED_RAD_S,
        max_accel_rad_s2=_ACCEL_RAD_S2,
    )
