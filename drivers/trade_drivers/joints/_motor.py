"""Motor and JointGroup on a bus. They check arguments, queue a job for the bus thread, and wait for it."""

from collections.abc import Sequence
from typing import Any, Generic, TypeVar

from trade import Resource
from trade.errors import DeviceSilent, LimitExceeded
from trade_drivers._validation import finite, one_each, valid, within
from trade_drivers.bus._angle_store import AngleStore
from trade_drivers.bus._gate import Command, admitted, at_once, span
from trade_drivers.bus._thread import BusThread
from trade_drivers.interfaces._motion import JointGroup, JointLimits, Motor, MotorState
from trade_drivers.joints._axis import Axis, AxisT
from trade_drivers.joints._cycle import ControlMode, Exchange
from trade_drivers.joints._jobs import Enable, Halt, Relax
from trade_drivers.joints._motion import Move
from trade_drivers.joints._setpoint import SetPoint
from trade_drivers.joints._trajectory_run import Follow
from trade_drivers.motion._plan import Plan
from trade_drivers.plugins._driver import ThreadedBus

_Exchange = TypeVar("_Exchange", bound=Exchange[Any])


class _Joints(Generic[AxisT, _Exchange]):
    """The base of motor and group: a bus and some of its joints."""

    def __init__(self, name: str, thread: BusThread[_Exchange], axes: Sequence[AxisT]) -> None:
        self._name = name
        self._thread = thread
        self._exchange = thread.exchange
        self._axes = tuple(axes)

    @property
    def resources(self) -> tuple[Resource, ...]:
        return tuple(axis.resource for axis in self._axes)

    def stop(self) -> None:
        self._exchange.stop(self._axes).wait(self._thread.alive)

    def enable(self) -> None:
        self._do(Enable, "enable")

    def relax(self) -> None:
        self._do(Relax, "relax")

    def _do(self, job_type: type[Enable[AxisT] | Relax[AxisT] | Halt[AxisT]], name: str) -> None:
        with admitted(f"{self._name}.{name}", self.resources, at_once(self._exchange.clock)) as terms:
            self._finish(job_type(self._exchange, self._axes, terms))

    def _finish(self, job: Command[AxisT, Any]) -> None:
        self._exchange.submit(job)
        job.wait(self._thread.alive)

    def _move(self, positions_rad: Sequence[float], speed_rad_s: float | None, argument: str) -> list[float]:
        service = f"{self._name}.move_to"
        goals = self._goals(positions_rad, service, argument)
        speed = None if speed_rad_s is None else finite(speed_rad_s, service, "speed_rad_s")
        speeds = [_speed_counts(axis, speed) for axis in self._axes]
        with admitted(service, self.resources, span(self._exchange.clock)) as terms:
            move = Move(self._exchange, self._axes, goals, speeds, terms)
            self._finish(move)
        return [axis.scale.angle_rad(counts) for axis, counts in zip(self._axes, move.final_counts, strict=True)]

    def _set(
        self,
        goals: Sequence[int],
        speeds: Sequence[int],
        service: str,
        valid_s: float,
        control_mode: ControlMode = ControlMode.GOALS,
    ) -> None:
        """Sends a set-point, which replaces the previous one; returns once it is sent."""
        until_ns = self._exchange.clock() + int(valid_s * 1e9)
        with admitted(service, self.resources, at_once(self._exchange.clock)) as terms:
            self._finish(SetPoint(self._exchange, self._axes, goals, speeds, terms, until_ns, control_mode))

    def _goals(self, positions_rad: Sequence[float], service: str, argument: str) -> list[int]:
        values = one_each(positions_rad, [axis.name for axis in self._axes], service, argument)
        return [_goal_counts(axis, value) for axis, value in zip(self._axes, values, strict=True)]

    def _states(self) -> list[MotorState]:
        return [self._state(axis) for axis in self._axes]

    def _state(self, axis: Axis) -> MotorState:
        try:
            return axis.state(self._exchange.clock(), self._exchange.stale_after_ns)
        except DeviceSilent as silent:
            raise self._exchange.absence(axis, silent) from None

    def _limits(self) -> list[JointLimits]:
        return [
            JointLimits(
                name=axis.name,
                min_rad=axis.joint.min_rad,
                max_rad=axis.joint.max_rad,
                max_speed_rad_s=axis.joint.max_speed_rad_s,
                max_accel_rad_s2=axis.joint.max_accel_rad_s2,
            )
            for axis in self._axes
        ]


class BusMotor(_Joints[AxisT, _Exchange], Motor):
    """One joint as a motor."""

    def state(self) -> MotorState:
        return self._states()[0]

    def limits(self) -> JointLimits:
        return self._limits()[0]

    def move_to(self, position_rad: float, speed_rad_s: float | None = None) -> float:
        return self._move([position_rad], speed_rad_s, "position_rad")[0]

    def set_velocity(self, velocity_rad_s: float, valid_s: float = 0.2) -> None:
        service = f"{self._name}.set_velocity"
        velocity, valid_s = finite(velocity_rad_s, service, "velocity_rad_s"), valid(valid_s, service)
        if velocity == 0:
            self._do(Halt, "set_velocity")
            return
        [axis] = self._axes
        ends, speeds = [_end_counts(axis, velocity)], [_speed_counts(axis, abs(velocity))]
        self._set(ends, speeds, service, valid_s, ControlMode.SPEEDS)


class BusGroup(_Joints[Axis, Exchange[Any]], JointGroup):
    """Joints of one bus as a group."""

    def joints(self) -> list[str]:
        return [axis.name for axis in self._axes]

    def state(self) -> list[MotorState]:
        return self._states()

    def limits(self) -> list[JointLimits]:
        return self._limits()

    def move_to(self, positions_rad: list[float], speed_rad_s: float | None = None) -> list[float]:
        return self._move(positions_rad, speed_rad_s, "positions_rad")

    def servo(self, positions_rad: list[float], valid_s: float = 0.2) -> None:
        service = f"{self._name}.servo"
        goals = self._goals(positions_rad, service, "positions_rad")
        self._set(goals, [axis.speed_counts for axis in self._axes], service, valid(valid_s, service))

    def stream(self, plan: Plan) -> list[float]:
        exchange, service = self._exchange, f"{self._name}.follow"
        with admitted(service, self.resources, span(exchange.clock)) as terms:
            job = Follow(exchange, self._axes, plan, terms)
            exchange.submit(job)
            job.wait(self._thread.alive, lambda: plan.course.report(exchange.clock()))
        return job.final_rad


class AttachedJoints(ThreadedBus[Exchange[Any]]):
    """A bus with its joints and its owner thread."""

    def __init__(self, thread: BusThread[Exchange[Any]], motor: type[BusMotor[Any, Any]] = BusMotor) -> None:
        super().__init__(thread)
        self._motor = motor
        self._axes = {axis.joint.name: axis for axis in thread.exchange.devices}

    def motor(self, joint: str) -> Motor:
        axis = self._axes[joint]
        return self._motor(axis.name, self._thread, [axis])

    def remember(self, angles: AngleStore) -> None:
        known = angles.load()
        for axis in self._thread.exchange.devices:
            if (span := known.get(axis.joint.name)) is not None and (sample := axis.sample) is not None:
                axis.zero.restore(span, axis.scale.angle_rad(sample.position))
        self._thread.exchange.save_angles = angles.save

    def group(self, name: str, joints: Sequence[str]) -> JointGroup:
        return BusGroup(name, self._thread, [self._axes[joint] for joint in joints])


def _end_counts(axis: Axis, velocity_rad_s: float) -> int:
    """Returns the end of the range in this direction; the device brakes by itself before it."""
    joint, sample = axis.joint, axis.sample
    # a joint outside its range by more than its resolution must not move further out
    end = joint.max_rad if velocity_rad_s > 0 else joint.min_rad
    angle_rad = end if sample is None else axis.scale.angle_rad(sample.position)
    if (angle_rad - end) * velocity_rad_s > abs(velocity_rad_s) * axis.resolution.arrived * axis.resolution.rad:
        raise LimitExceeded(what=axis.name, value=angle_rad, lower=joint.min_rad, upper=joint.max_rad, unit="rad")
    return round(axis.scale.counts(end))


def _goal_counts(axis: Axis, position_rad: float) -> int:
    joint = axis.joint
    return round(axis.scale.counts(within(position_rad, joint.min_rad, joint.max_rad, axis.name, "rad")))


def _speed_counts(axis: Axis, speed_rad_s: float | None) -> int:
    if speed_rad_s is None:
        return axis.speed_counts
    within(speed_rad_s, axis.resolution.rad_s, axis.joint.max_speed_rad_s, f"{axis.name} speed", "rad/s")
    return max(1, int(speed_rad_s / axis.resolution.rad_s))
