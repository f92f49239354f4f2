"""Checks, runs and measures a replay."""

import math
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from msgspec import Struct

from trade import Container, Handle, Stream, where
from trade.errors import ConfigurationError, DeviceError
from trade_drivers import JointLimits, Tolerances
from trade_gateway._usage import UsageError
from trade_gateway.recording._channels import JointStates
from trade_gateway.recording._motion import Motion, deviation, fitted, motion_of, motions, moving
from trade_gateway.recording._sources import joint_states
from trade_gateway.terminal._calls import run_to_end

_LIMBS: Final = where(kind="JointGroup") | where(kind="Arm")
_FIND_S: Final = 5.0
_START_RAD_S: Final = 0.3
"""The highest speed of the move to the start."""
_MORE_S: Final = 15.0
"""How much longer than its motion a call may take, in seconds."""
_MEASURED_HZ: Final = 50.0


class Replayed(Struct, frozen=True, kw_only=True):
    """The deviations of a replay from its recording."""

    group: str
    joints: list[str]
    duration_s: float
    greatest_rad: float
    rms_rad: float
    """Root of the mean square over all joints."""
    greatest_by_joint_rad: list[float]
    rms_by_joint_rad: list[float]
    measurements: int


def chosen(file: Path, group: str | None) -> Motion:
    """Returns the motion to replay, without standstill at its ends.

    Raises:
        ConfigurationError: the recording has no motion, or the motion has gaps.
        UsageError: the recording has several motions, or not this one, or this is of a gripper or of ROS.
    """
    recorded = motions(file)
    found = {name: states for name, states in recorded.items() if not (states[0].is_gripper or states[0].is_ros)}
    if group in recorded and group not in found:
        what = "a gripper" if recorded[group][0].is_gripper else "of ROS"
        raise UsageError(where="--group", problem=f"{group} is {what}; only joints and arms of TRADE are replayed")
    if not found:
        raise ConfigurationError(where=str(file), problem="has no joints")
    if group is None and len(found) > 1:
        problem = f"it has {', '.join(sorted(found))}; say which with --group"
        raise UsageError(where=str(file), problem=problem)
    name = group or next(iter(found))
    if name not in found:
        raise UsageError(where="--group", problem=f"{file} has no {name}; it has {', '.join(sorted(found))}")
    return moving(motion_of(name, found[name]))


class Robot:
    """The joints to move: those of a group, or of an arm."""

    def __init__(self, container: Container, motion: Motion, speed: float) -> None:
        """Looks the joints up and checks everything; moves nothing.

        Raises:
            ConfigurationError: the group has other joints.
            LimitExceeded: the motion would break a limit.
        """
        self._motion = motion
        self._container = container
        limits = self._service("limits")
        found: Any = limits()
        self._is_arm = "Arm" in limits.kinds
        self._limits: list[JointLimits] = found.joints if self._is_arm else found
        names = [limit.name for limit in self._limits]
        self._arm_joints = names if self._is_arm else None
        if sorted(names) != sorted(motion.joints):
            problem = f"it was recorded with {', '.join(motion.joints)}; here it has {', '.join(names)}"
            raise ConfigurationError(where=motion.group, problem=problem)
        self._trajectory, self.speed = fitted(motion, speed, self._limits)

    def _service(self, name: str) -> Handle:
        wanted = where(name=name, group=self._motion.group) & _LIMBS
        exact = [one for one in self._container.services(wanted) if self._motion.group in one.groups]
        return exact[0] if len(exact) == 1 else self._container.find(wanted, wait_s=_FIND_S)

    @property
    def duration_s(self) -> float:
        """The duration of the motion, in seconds."""
        return self._trajectory.points[-1].time_from_start_s

    def far_from_start(self) -> dict[str, float]:
        """Returns the joints that are not at the start of the recording, with their distance in rad."""
        begins = dict(zip(self._motion.joints, self._motion.start, strict=True))
        states = joint_states(self._service("state")(), time.time(), self._arm_joints)
        places = zip(states.names, states.position_rad, strict=True)
        away = {name: position - begins[name] for name, position in places}
        return {name: off for name, off in away.items() if abs(off) > Tolerances().start_rad}

    def go_to_start(self) -> None:
        """Moves slowly to the start. Raises what the move raises."""
        begins = dict(zip(self._motion.joints, self._motion.start, strict=True))
        goals = [begins[limit.name] for limit in self._limits]
        speed = min(_START_RAD_S, *(limit.max_speed_rad_s for limit in self._limits))
        farthest = max(map(abs, self.far_from_start().values()), default=0.0)
        move = self._service("move_joints" if self._is_arm else "move_to")
        run_to_end(move.with_(deadline_s=farthest / speed + _MORE_S), goals, speed)

    def follow(self) -> Replayed:
        """Replays the motion and measures it. Raises what the motion raises."""
        deadline_s = self.duration_s + _MORE_S
        measured: list[JointStates] = []
        with self._container.stream(self._service("state"), hz=_MEASURED_HZ, keep=100_000) as states:
            run_to_end(self._service("follow").with_(deadline_s=deadline_s), self._trajectory)
            measured += self._taken(states)
        return self._compared(motion_of(self._motion.group, measured))

    def _taken(self, states: Stream) -> Iterator[JointStates]:
        while True:
            try:
                sample = states.take()
            except DeviceError:  # briefly not measured
                continue
            if sample is None:
                return
            yield joint_states(sample.value, sample.at_ns / 1e9, self._arm_joints)  # no step of a wall clock is in it

    def _compared(self, measured: Motion) -> Replayed:
        found, _ = deviation(self._motion, self.speed, measured)
        squares = [rms * rms for rms in found.rms_rad]
        return Replayed(
            group=self._motion.group,
            joints=list(self._motion.joints),
            duration_s=self.duration_s,
            greatest_rad=max(found.greatest_rad),
            rms_rad=math.sqrt(sum(squares) / len(squares)),
            greatest_by_joint_rad=list(found.greatest_rad),
            rms_by_joint_rad=list(found.rms_rad),
            measurements=min(len(track.times_s) for track in measured.tracks),
        )


def not_at_start(group: str, far: Mapping[str, float]) -> ConfigurationError:
    """Returns the error for a robot that is not at the start of the recording."""
    named = ", ".join(f"{joint} is {off:+.2f} rad off" for joint, off in far.items())
    problem = f"is not at the start of the recording: {named}; --go-to-start moves it there first"
    return ConfigurationError(where=group, problem=problem)
