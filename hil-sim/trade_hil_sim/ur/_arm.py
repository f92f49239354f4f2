"""A simulated arm: six joints, brakes, safety modes. It takes commands, and moves when `advance` is called."""

from collections.abc import Callable, Sequence
from math import pi
from typing import Final

import msgspec

from trade_hil_sim.faults._commands import SimulationError
from trade_hil_sim.log._byte_log import LogEntry

from ._kinematics import flange, joints_for, pose_between, pose_of, way_of
from ._motions import AtRest, Braking, Free, Motion, PathMotion, Servo, Speed
from ._table import CB3, E_SERIES, MODELS, RobotMode, SafetyMode, Series

JOINTS: Final = ("base", "shoulder", "elbow", "wrist_1", "wrist_2", "wrist_3")
HOME: Final = (0.0, -pi / 2, pi / 2, -pi / 2, -pi / 2, 0.0)
"""The initial pose of a simulated arm: elbow up, tool pointing down."""
_LIMIT_RAD: Final = 2 * pi
_HALT_RAD_S2: Final = 15.0
"""Deceleration when its program ends or safety stops it."""
_POWER_S: Final = 0.2
_UNLOCK_S: Final = 5.0
_JAMMED_S: Final = 0.3
_PAUSING_S: Final = 0.1
"""A safeguard stop brakes it to rest on its path in this time."""
_EVERY_RAD: Final = 0.02
_EVERY_M: Final = 0.01
Six = tuple[float, ...]


class Arm:
    """Six joints behind a controller.

    Args:
        model: such as ``UR5e``.
        name: of the arm in the robot file.
        q: its joint angles, in rad.
        running: powered, brakes released; else it is off.
        t: now, on the clock of `advance`.
        unlock_s: how long after a protective stop it can be unlocked at the earliest.
    """

    def __init__(
        self,
        model: str = "UR5e",
        *,
        name: str = "",
        q: Six = HOME,
        running: bool = True,
        t: float = 0.0,
        unlock_s: float = _UNLOCK_S,
    ) -> None:
        if model not in MODELS:
            raise SimulationError(f"{model!r} is not simulated; there is {', '.join(MODELS)}")
        self.model, self.name = model, name
        self.q, self.qd = tuple(q), (0.0,) * 6
        self.robot_mode = RobotMode.RUNNING if running else RobotMode.POWER_OFF
        self.safety_mode = SafetyMode.NORMAL
        self.speed_fraction = 1.0
        self.emit: Callable[[LogEntry], None] = lambda _: None
        self.stopped: Callable[[], None] = lambda: None
        """Called when safety ends whatever program runs."""
        self.paused: Callable[[bool], None] = lambda _: None
        """Called when a safeguard stop pauses it, and when that is over."""
        self.t = t
        self.jammed = False
        self._motion: Motion = AtRest()
        self._moving = False
        self._unlock_s, self._locked_at = unlock_s, t
        self._jammed_s = 0.0
        self._pace = 1.0
        """Fraction of full speed: 0 while a safeguard stop pauses it."""
        self._modes: list[tuple[float, RobotMode]] = []

    # --- state

    @property
    def series(self) -> Series:
        """The series of its controller."""
        return E_SERIES if self.model.endswith("e") else CB3

    @property
    def ready(self) -> bool:
        """Powered, brakes off, and no safety stop."""
        return self.robot_mode is RobotMode.RUNNING and self.safety_mode.moves

    @property
    def moving(self) -> bool:
        """Whether any joint turns."""
        return self._moving

    @property
    def motion(self) -> Motion:
        """Its present motion."""
        return self._motion

    @property
    def freedrive(self) -> bool:
        """Whether it can be moved by hand."""
        return isinstance(self._motion, Free)

    @property
    def speeds(self) -> Six:
        """How fast the joints turn, in rad/s."""
        return (0.0,) * 6 if not self._pace or self._held_up else self.qd

    def pose(self, q: Sequence[float] | None = None) -> Six:
        """The pose of the flange: x, y, z in m, and a rotation vector in rad."""
        return pose_of(flange(MODELS[self.model], self.q if q is None else q))

    def joints_for(self, pose: Sequence[float], near: Sequence[float] | None = None) -> Six | None:
        """The joint angles for a pose nearest to these, or to where it is; None if there are none."""
        return joints_for(MODELS[self.model], pose, self.q if near is None else near)

    # --- time

    def advance(self, dt: float) -> None:
        """Let a step of time pass."""
        self.t += dt
        while self._modes and self.t >= self._modes[0][0]:
            self._enter(self._modes.pop(0)[1])
        if self.jammed and not self._motion.done:
            self._strain(dt)
            return
        self._pace = self._paced(dt)
        if not self._pace or self._held_up:
            self._rest()
            return
        dt *= self._pace
        q, self.qd = self._motion.step(self.q, self.qd, dt * self.speed_fraction if self.ready else dt)
        if self._motion.done:
            self._motion = Free() if self.freedrive else AtRest()
            self.qd = (0.0,) * 6
        if any(abs(angle) > _LIMIT_RAD for angle in q):
            self.protective_stop("a joint is at its limit")
            q = tuple(max(-_LIMIT_RAD, min(_LIMIT_RAD, angle)) for angle in q)
        turned = max(abs(a - b) for a, b in zip(q, self.q, strict=True)) > 1e-9
        if turned and not self._moving:
            self.note("motion_started")
        self.q, was, self._moving = q, self._moving, turned or any(abs(speed) > 1e-6 for speed in self.qd)
        if was and not self._moving:
            self.note("at_rest")

    @property
    def _held_up(self) -> bool:
        """Whether the speed slider is at zero."""
        return self.ready and not self.speed_fraction

    def _paced(self, dt: float) -> float:
        change = -dt / _PAUSING_S if self.safety_mode is SafetyMode.SAFEGUARD_STOP else dt / _PAUSING_S
        return max(0.0, min(1.0, self._pace + change))

    def _rest(self) -> None:
        if self._moving:
            self._moving = False
            self.note("at_rest")

    def _strain(self, dt: float) -> None:
        self._rest()
        self.qd = (0.0,) * 6
        self._jammed_s += dt
        if self._jammed_s >= _JAMMED_S:
            self.protective_stop("it is far from its set-point; check for an obstacle")

    # --- commands

    def move_joints(self, goal: Sequence[float], speed: float, accel: float) -> bool:
        """Move straight in joint space: speed in rad/s and acceleration of the joint that turns most."""
        length = max(abs(b - a) for a, b in zip(self.q, goal, strict=True))
        return self._begin(PathMotion([self.q, tuple(goal)], length, speed, accel))

    def move_line(self, pose: Sequence[float], speed: float, accel: float) -> bool:
        """Move straight in space: speed in m/s; False, and a protective stop, if the way leads out of reach."""
        start = self.pose()
        metres, turn = way_of(start, pose)
        count = max(2, int(metres / _EVERY_M) + 1, int(turn / _EVERY_RAD / 2) + 1)
        points, near = [self.q], self.q
        for k in range(1, count + 1):
            found = joints_for(MODELS[self.model], pose_between(start, pose, k / count), near)
            if found is None or max(abs(a - b) for a, b in zip(found, near, strict=True)) > 0.5:
                self.protective_stop("the way leads out of reach")
                return False
            points.append(found)
            near = found
        return self._begin(PathMotion(points, metres or turn, speed, accel))

    def servo(self, target: Sequence[float]) -> bool:
        """Follow this target, at once."""
        if isinstance(self._motion, Servo):
            self._motion.target = tuple(target)
            return self.ready
        return self._begin(Servo(tuple(target)))

    def turn(self, speeds: Sequence[float], accel: float, lasts_s: float) -> bool:
        """Move at these speeds; repeating the same command changes nothing, so it can come in every cycle."""
        asked = (tuple(speeds), accel, lasts_s)
        if isinstance(self._motion, Speed) and self._motion.asked == asked and lasts_s <= 0:
            return self.ready
        return self._begin(Speed(tuple(speeds), accel, lasts_s))

    def free(self, on: bool) -> bool:
        """Switch freedrive."""
        return self._begin(Free() if on else AtRest())

    def halt(self, decel_rad_s2: float = _HALT_RAD_S2) -> None:
        """Brake, and hold."""
        self._motion = Braking(decel_rad_s2) if self._moving else AtRest()

    def _begin(self, motion: Motion) -> bool:
        if not self.ready:
            return False
        self._jammed_s = 0.0
        self._motion = motion
        return True

    # --- power and safety

    def power(self, on: bool) -> bool:
        """Switch the arm's power; the brakes stay on."""
        if not on:
            self._modes.clear()
            self.halt()
            self._enter(RobotMode.POWER_OFF)
            self.stopped()
        elif self.robot_mode is RobotMode.POWER_OFF:
            self._modes = [(self.t + _POWER_S / 2, RobotMode.POWER_ON), (self.t + _POWER_S, RobotMode.IDLE)]
        return True

    def release_brakes(self) -> bool:
        """Release the brakes; powers the arm on first if needed."""
        self.power(True)
        if self.robot_mode is not RobotMode.RUNNING:
            after = self._modes[-1][0] if self._modes else self.t
            self._modes.append((after + _POWER_S, RobotMode.RUNNING))
        return True

    def protective_stop(self, reason: str) -> None:
        """Stop, and do not move until it is unlocked."""
        self.safety(SafetyMode.PROTECTIVE_STOP, reason)

    def safety(self, mode: SafetyMode, reason: str = "") -> None:
        """Enter a safety mode. One that it may not move in ends its program; a safeguard stop only holds it up."""
        if mode is self.safety_mode:
            return
        was, self.safety_mode, self._locked_at = self.safety_mode, mode, self.t
        self.note(mode.name.lower(), detail=reason)
        if SafetyMode.SAFEGUARD_STOP in {was, mode}:
            self.paused(mode is SafetyMode.SAFEGUARD_STOP)
        if mode.cuts_power:
            self.power(False)
        elif not mode.moves and mode is not SafetyMode.SAFEGUARD_STOP:
            self.halt()
            self.stopped()

    def unlock(self) -> bool:
        """End a protective stop; not within the first seconds."""
        if self.safety_mode is SafetyMode.PROTECTIVE_STOP and self.t - self._locked_at < self._unlock_s:
            return False
        if self.safety_mode is SafetyMode.PROTECTIVE_STOP:
            self._jammed_s = 0.0
            self.safety(SafetyMode.NORMAL)
        return True

    def reboot(self) -> None:
        """Reset as after a loss of power: off, its brakes on, all state lost."""
        self._motion, self._moving, self.qd, self._pace = AtRest(), False, (0.0,) * 6, 1.0
        self._modes.clear()
        self.safety_mode, self.speed_fraction = SafetyMode.NORMAL, 1.0
        self._enter(RobotMode.POWER_OFF)

    def _enter(self, mode: RobotMode) -> None:
        if mode is not self.robot_mode:
            self.robot_mode = mode
            self.note(mode.name.lower())

    def note(self, name: str, *, detail: str = "") -> None:
        """Log an event, with where the joints are."""
        where = msgspec.json.encode([round(angle, 6) for angle in self.q]).decode()
        self.emit(LogEntry(self.t, "", "event", name, joint=self.name, detail=detail or where))
