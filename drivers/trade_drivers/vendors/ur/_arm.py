"""A Universal Robots arm as an Arm. It checks arguments, queues a job for the bus thread, and waits for it."""

import threading
from collections.abc import Callable
from typing import Final

from trade import Permit, Resource, permit
from trade.errors import DeadlineExceeded, DeviceSilent, InvalidArgument
from trade_drivers._validation import finite, one_each, valid, within
from trade_drivers.bus._gate import admitted, expiry, span
from trade_drivers.bus._thread import BusThread
from trade_drivers.interfaces._arm import Arm, ArmLimits, ArmState
from trade_drivers.motion._plan import JointLimits, Plan
from trade_drivers.vendors.ur._arm_state import IDLE, RUNNING, ArmStatus
from trade_drivers.vendors.ur._dashboard import DashboardError, ask
from trade_drivers.vendors.ur._exchange import Exchange
from trade_drivers.vendors.ur._jobs import (
    ArmCommand,
    EndFreedrive,
    Follow,
    Freedrive,
    LineMove,
    Move,
    Scaling,
    SetPoint,
)

_POSE: Final = ("x", "y", "z", "rx", "ry", "rz")
_STOP_S: Final = 0.2
_ASK_S: Final = 1.0
_SWITCH_NS: Final = 30_000_000_000
"""Power and brakes of a real arm take seconds."""
_TAKING_NS: Final = 10_000_000_000
_LOOK_S: Final = 0.01


class UrArm(Arm):
    """The arm of one controller."""

    def __init__(self, thread: BusThread[Exchange], limb: ArmStatus) -> None:
        self._thread = thread
        self._exchange = thread.exchange
        self._limb = limb
        self._name = limb.name

    @property
    def resources(self) -> tuple[Resource, ...]:
        return (self._limb.resource,)

    def state(self) -> ArmState:
        exchange = self._exchange
        free = isinstance(self._limb.motion, Freedrive)
        try:
            return self._limb.state(exchange.clock(), exchange.stale_after_ns, freedrive=free)
        except DeviceSilent as silent:
            raise exchange.absence(self._limb, silent) from None

    def limits(self) -> ArmLimits:
        arm = self._limb.arm
        joints = [
            JointLimits(
                name=name,
                min_rad=low,
                max_rad=high,
                max_speed_rad_s=arm.max_speed_rad_s,
                max_accel_rad_s2=arm.max_accel_rad_s2,
            )
            for name, low, high in zip(self._limb.joints, arm.min_rad, arm.max_rad, strict=True)
        ]
        return ArmLimits(
            name=self._name,
            joints=joints,
            max_speed_m_s=arm.max_speed_m_s,
            max_accel_m_s2=arm.max_accel_m_s2,
            poses=arm.poses,
        )

    def move_joints(self, positions_rad: list[float], speed_rad_s: float | None = None) -> list[float]:
        service = f"{self._name}.move_joints"
        goal = self._angles(positions_rad, service)
        return self._move(Move, goal, self._joint_speed(speed_rad_s, service), service).positions_rad

    def move_to_pose(self, name: str, speed_rad_s: float | None = None) -> list[float]:
        service, poses = f"{self._name}.move_to_pose", self._limb.arm.poses
        if name not in poses:
            problem = f"there is no pose {name!r}; there is {', '.join(poses) or 'none'}"
            raise InvalidArgument(service=service, argument="name", problem=problem)
        return self._move(Move, poses[name], self._joint_speed(speed_rad_s, service), service).positions_rad

    def move_line(self, pose: list[float], speed_m_s: float | None = None) -> list[float]:
        service, most = f"{self._name}.move_line", self._limb.arm.max_speed_m_s
        goal = one_each(pose, _POSE, service, "pose")
        speed = most if speed_m_s is None else finite(speed_m_s, service, "speed_m_s")
        within(speed, 1e-4, most, f"{self._name} speed", "m/s")
        return self._move(LineMove, goal, speed, service).pose

    def servo(self, positions_rad: list[float], valid_s: float = 0.2) -> None:
        service, exchange = f"{self._name}.servo", self._exchange
        goal, valid_s = self._angles(positions_rad, service), valid(valid_s, service)
        with admitted(service, self.resources, self._at_once()) as terms:
            self._finish(SetPoint(exchange, goal, terms, int(valid_s * 1e9)))

    def stream(self, plan: Plan) -> list[float]:
        exchange = self._exchange
        with admitted(f"{self._name}.follow", self.resources, self._span()) as terms:
            job = Follow(exchange, plan, terms)
            exchange.submit(job)
            job.wait(self._thread.alive, lambda: plan.course.report(exchange.clock()))
        return self.state().positions_rad

    def stop(self) -> None:
        ticket = self._exchange.stop()  # first, so that earlier commands are void from here on
        problem: DashboardError | None = None
        try:
            ask(self._limb.bus, "stop", _STOP_S)
        except DashboardError as unheard:
            problem = unheard
        ticket.wait(self._thread.alive)
        if problem is not None and not self._limb.at_rest(self._exchange.clock(), self._exchange.stale_after_ns):
            raise self._limb.silent_error(self._exchange.clock()) from problem

    def freedrive(self, on: bool) -> None:
        with admitted(f"{self._name}.freedrive", self.resources, self._at_once()) as terms:
            self._finish((Freedrive if on else EndFreedrive)(self._exchange, terms))

    def set_speed_scaling(self, fraction: float) -> None:
        service = f"{self._name}.set_speed_scaling"
        within(finite(fraction, service, "fraction"), 0.01, 1.0, f"{self._name} speed scaling", "")
        with admitted(service, self.resources, self._at_once()) as terms:
            self._finish(Scaling(self._exchange, fraction, terms))

    def unlock_protective_stop(self) -> None:
        self._switch("unlock protective stop", "Protective stop releasing", lambda: self.state().safety == "normal")

    def power_on(self) -> None:
        self._switch("power on", "Powering on", lambda: self._mode() >= IDLE)

    def release_brakes(self) -> None:
        if self.state().fault and not self.state().powered:
            raise self._limb.fault_error()
        self._switch("brake release", "Brake releasing", lambda: self._mode() == RUNNING)

    # --- parts

    def _at_once(self) -> tuple[int, None]:
        """Like ``at_once``, but a plain Python call may wait until a process has started and taken control."""
        clock = self._exchange.clock
        expires_ns, ends = expiry(clock)
        return expires_ns if ends else clock() + _TAKING_NS, None

    def _span(self) -> tuple[int, int | None]:
        """Like ``span``, with the same exception."""
        expires_ns, until_ns = span(self._exchange.clock)
        return self._at_once() if until_ns is None else (expires_ns, until_ns)

    def _finish(self, job: ArmCommand) -> None:
        self._exchange.submit(job)
        job.wait(self._thread.alive)

    def _mode(self) -> int:
        return self._limb.fresh(self._exchange.clock(), self._exchange.stale_after_ns).robot_mode

    def _angles(self, positions_rad: list[float], service: str) -> list[float]:
        arm, names = self._limb.arm, self._limb.joints
        goal = one_each(positions_rad, names, service, "positions_rad")
        for name, angle, low, high in zip(names, goal, arm.min_rad, arm.max_rad, strict=True):
            within(angle, low, high, name, "rad")
        return goal

    def _joint_speed(self, speed_rad_s: float | None, service: str) -> float:
        most = self._limb.arm.max_speed_rad_s
        speed = most if speed_rad_s is None else finite(speed_rad_s, service, "speed_rad_s")
        return within(speed, 1e-3, most, f"{self._name} speed", "rad/s")

    def _move(self, move_type: type[Move], goal: list[float], speed: float, service: str) -> ArmState:
        with admitted(service, self.resources, self._span()) as terms:
            self._finish(move_type(self._exchange, goal, speed, terms))
        return self.state()

    def _switch(self, line: str, expected: str, reached: Callable[[], bool]) -> None:
        """Sends a dashboard command, and waits until the controller shows its effect."""
        clock, service = self._exchange.clock, f"{self._name}.{line.replace(' ', '_')}"
        _, until_ns = span(clock)
        until_ns = until_ns or clock() + _SWITCH_NS
        self.state()
        with permit(self.resources) as permitted:
            self._order(line, expected, permitted)
            while not reached():
                permitted.gate()
                if clock() >= until_ns:
                    raise DeadlineExceeded(service=service, deadline_s=_SWITCH_NS / 1e9)
                threading.Event().wait(_LOOK_S)

    def _order(self, line: str, expected: str, permitted: Permit) -> None:
        permitted.gate()
        try:
            answer = ask(self._limb.bus, line, _ASK_S)
        except DashboardError as problem:
            raise self._limb.silent_error(self._exchange.clock()) from problem
        if not answer.startswith(expected):
            raise self._limb.fault_error(f"asked to {line}, its controller says: {answer}")
