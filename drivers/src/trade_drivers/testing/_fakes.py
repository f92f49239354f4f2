"""A joint group in memory, for tests of what uses one: it moves at once, and refuses what any other one refuses."""

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
    """Joints that are at once where they are told to be. For tests of behaviours, not of drivers.

    Its services, types, limits and refusals are those of a `JointGroup`; locks, stops and e-stops hold for it. It has
    no time and no torque: nothing is ever under way, so no stop or deadline ends a motion of it.
    """

    def __init__(self, joints: Sequence[str], limits: Sequence[JointLimits] | None = None) -> None:
        """Joints at 0 rad, relaxed.

        Args:
            joints: their full names, such as ``rosie.neck.pan``.
            limits: of each; by default 2.6 rad to either side, 6 rad/s and 50 rad/s2.
        """
        self.went: list[list[float]] = []
        """Where it was told to be, in rad, oldest first; of a trajectory its end."""
        self._joints = list(joints)
        self._limits = [_limits(joint) for joint in joints] if limits is None else list(limits)
        self._resources = tuple(Resource(joint) for joint in joints)
        self._angles = [0.0] * len(self._joints)
        self._enabled = False

    @property
    def resources(self) -> tuple[Resource, ...]:
        """The joints."""
        return self._resources

    def joints(self) -> list[str]:
        """Their names."""
        return list(self._joints)

    def state(self) -> list[MotorState]:
        """At rest where they are, with no load."""
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
        """As it was made with."""
        return list(self._limits)

    def move_to(self, positions_rad: list[Position], speed_rad_s: Speed | None = None) -> list[float]:
        """Be there; returns the angles."""
        goals = self._checked(positions_rad, "move_to")
        if speed_rad_s is not None:
            for limits in self._limits:
                within(speed_rad_s, 0.0, limits.max_speed_rad_s, limits.name, "rad/s")
        return self._go(goals)

    def servo(self, positions_rad: list[Position], valid_s: Valid = 0.2) -> None:
        """Be there."""
        valid(valid_s, "servo")
        self._go(self._checked(positions_rad, "servo"))

    def stream(self, plan: Plan) -> list[float]:
        """Be at the end of a trajectory that begins where they are, and tell of its whole way."""
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
        """Nothing is under way."""

    def enable(self) -> None:
        """Torque on, as far as it tells."""
        self._switch(on=True)

    def relax(self) -> None:
        """Torque off, as far as it tells."""
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
