"""An arm in memory for tests: it moves instantly, and refuses the same commands as a real one."""

import math
import time
from collections.abc import Sequence
from typing import Final

from trade import Resource
from trade.errors import InvalidArgument
from trade_drivers._validation import finite, one_each, valid, within
from trade_drivers.interfaces._arm import Angles, Arm, ArmLimits, ArmState, Fraction, Pose, Safety, ToolSpeed
from trade_drivers.interfaces._motion import Speed, Valid
from trade_drivers.motion._plan import JointLimits, Plan
from trade_drivers.testing._fake_device import FakeActuator, end_of, report_whole
from trade_drivers.testing._fake_joints import checked_speed, start_rad

_JOINTS: Final = ("base", "shoulder", "elbow", "wrist_1", "wrist_2", "wrist_3")
_COORDINATES: Final = ("x", "y", "z", "rx", "ry", "rz")
_POSE: Final = (0.4, 0.0, 0.4, 0.0, math.pi, 0.0)
_LEAST_M_S: Final = 1e-4
_SLOWEST: Final = 0.01


class FakeArm(FakeActuator[list[float]], Arm):
    """An arm that reaches each goal instantly. For tests of behaviours, not of drivers.

    Its services, types, limits and refusals are those of an `Arm`. It has no kinematics: ``move_line`` changes the pose
    alone, every other motion the angles alone. In ``commands``, the goal of ``move_line`` is a pose.
    """

    def __init__(self, name: str, limits: ArmLimits | None = None, *, powered: bool = True) -> None:
        """An arm with each joint at 0 rad or the nearest end of its range.

        Args:
            name: its full name, such as ``rosie.right``.
            limits: by default one turn to either side, 3 rad/s, 1 m/s, and the pose ``home`` at 0 rad.
            powered: it has power, and its brakes are released.
        """
        super().__init__(name, [Resource(name)])
        self._limits = _limits(name) if limits is None else limits
        self._angles = [start_rad(limit) for limit in self._limits.joints]
        self._pose = list(_POSE)
        self._powered = self._enabled = powered
        self._freedrive = False
        self._scaling = 1.0
        self._safety: Safety = "normal"

    def trip(self, safety: Safety) -> None:
        """Puts the safety system into a state: commands raise ``DeviceFault`` unless it is normal or reduced.

        A protective stop lasts until ``unlock_protective_stop()``, all others until ``recover()``. An emergency stop
        switches the power off.
        """
        self._safety = safety
        if safety not in ("normal", "reduced"):
            self._end_freedrive()
        if safety == "emergency stop":
            self._powered = self._enabled = False

    def fail(self, fault: str) -> None:
        """Reports a fault until ``recover()``: commands raise ``DeviceFault``. Freedrive ends."""
        super().fail(fault)
        self._end_freedrive()

    def recover(self) -> None:
        """Ends the fault and the silence, and resets the safety system."""
        super().recover()
        self._safety = "normal"

    def state(self) -> ArmState:
        """Returns the state, which is at rest unless a test holds a motion up."""
        self._answer()
        return ArmState(
            name=self._name,
            positions_rad=list(self._angles),
            velocities_rad_s=[0.0] * len(self._angles),
            pose=list(self._pose),
            powered=self._powered,
            enabled=self._enabled,
            moving=self._moving,
            freedrive=self._freedrive,
            safety="fault" if self._fault else self._safety,
            speed_scaling=self._scaling,
            fault=self._problem(),
            measured_at=time.monotonic(),
            age_s=0.0,
        )

    def limits(self) -> ArmLimits:
        """Returns the limits from the constructor."""
        return self._limits

    def move_joints(self, positions_rad: Angles, speed_rad_s: Speed | None = None) -> list[float]:
        """Sets the angles, and returns them."""
        return self._go("move_joints", self._checked(positions_rad, "move_joints", speed_rad_s))

    def move_line(self, pose: Pose, speed_m_s: ToolSpeed | None = None) -> list[float]:
        """Sets the pose, and returns it."""
        goal = one_each(pose, _COORDINATES, "move_line", "pose")
        if speed_m_s is not None:
            speed = finite(speed_m_s, "move_line", "speed_m_s")
            within(speed, _LEAST_M_S, self._limits.max_speed_m_s, f"{self._name} speed", "m/s")
        with self._command("move_line", goal):
            self._end_freedrive()
            self._pose = list(goal)
        return list(goal)

    def move_to_pose(self, name: str, speed_rad_s: Speed | None = None) -> list[float]:
        """Sets the angles to those of a named pose, and returns them."""
        poses = self._limits.poses
        if name not in poses:
            problem = f"{name!r} is not a pose of {self._name}; it has {', '.join(sorted(poses)) or 'none'}"
            raise InvalidArgument(service="move_to_pose", argument="name", problem=problem)
        return self._go("move_to_pose", self._checked(poses[name], "move_to_pose", speed_rad_s))

    def servo(self, positions_rad: Angles, valid_s: Valid = 0.2) -> None:
        """Sets the angles."""
        valid(valid_s, "servo")
        self._go("servo", self._checked(positions_rad, "servo", None))

    def stream(self, plan: Plan) -> list[float]:
        """Sets the angles to the end of a trajectory, and reports its whole progress."""
        at_rest = self._go("follow", end_of(plan, self._angles))
        report_whole(plan)
        return at_rest

    def stop(self) -> None:
        """Ends freedrive; no motion takes time."""
        self._end_freedrive()
        self._stop()

    def freedrive(self, on: bool) -> None:
        """Reports freedrive, during which the arm counts as moving."""
        with self._command("freedrive", moves=on):
            self._freedrive = self._resources[0].moving = on

    def set_speed_scaling(self, fraction: Fraction) -> None:
        """Reports the fraction."""
        scaling = finite(fraction, "set_speed_scaling", "fraction")
        within(scaling, _SLOWEST, 1.0, f"{self._name} speed scaling", "")
        with self._command("set_speed_scaling"):
            self._scaling = scaling

    def unlock_protective_stop(self) -> None:
        """Ends a protective stop."""
        with self._command("unlock_protective_stop"):
            if self._safety != "protective stop":
                raise self._refusal("there is no protective stop", "call safety_state() first")
            self._safety = "normal"

    def power_on(self) -> None:
        """Reports power; the brakes stay on."""
        with self._command("power_on"):
            self._powered = True

    def release_brakes(self) -> None:
        """Reports released brakes."""
        with self._command("release_brakes"):
            if problem := self._problem():
                raise self._refusal(problem)
            if not self._powered:
                raise self._refusal("the power is off", "call power_on()")
            self._enabled = True

    def _problem(self) -> str:
        return self._fault or ("" if self._safety in ("normal", "reduced") else self._safety)

    def _work(self) -> None:
        if problem := self._problem():
            raise self._refusal(problem)
        if not self._enabled:
            raise self._refusal("its brakes are on", "call power_on() and release_brakes()")

    def _checked(self, positions_rad: Sequence[float], service: str, speed_rad_s: float | None) -> list[float]:
        joints = self._limits.joints
        goals = one_each(positions_rad, [limit.name for limit in joints], service, "positions_rad")
        for goal, limit in zip(goals, joints, strict=True):
            within(goal, limit.min_rad, limit.max_rad, limit.name, "rad")
            checked_speed(speed_rad_s, limit, service)
        return goals

    def _go(self, service: str, goals: list[float]) -> list[float]:
        with self._command(service, goals):
            self._end_freedrive()
            self._angles = list(goals)
        return list(goals)

    def _end_freedrive(self) -> None:
        self._freedrive = self._resources[0].moving = False


def _limits(name: str) -> ArmLimits:
    joints = [
        JointLimits(
            name=f"{name}.{joint}",
            min_rad=-math.tau,
            max_rad=math.tau,
            max_speed_rad_s=3.0,
            max_accel_rad_s2=40.0,
        )
        for joint in _JOINTS
    ]
    home = {"home": [0.0] * len(_JOINTS)}
    return ArmLimits(name=name, joints=joints, max_speed_m_s=1.0, max_accel_m_s2=5.0, poses=home)
