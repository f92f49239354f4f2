"""The state of one joint on its bus thread, and the conversion of counts to radians."""

import time
from abc import abstractmethod
from collections.abc import Sequence
from math import ceil, floor
from typing import Any, ClassVar, Final, TypeVar

from msgspec import Struct

from trade import Permit, Resource
from trade.errors import DeviceFault, LimitExceeded
from trade_drivers.bus._cycle import BusDevice
from trade_drivers.bus._jobs import AwaitedJob
from trade_drivers.interfaces._motion import MotorState
from trade_drivers.joints._zero import Zero
from trade_robotfile import Joint

AxisT = TypeVar("AxisT", bound="Axis")
"""The axis type of one vendor."""

_AT_REST: Final = 2


class Resolution(Struct, frozen=True):
    """The resolution of a device's counts, and its thresholds for rest and arrival."""

    rad: float
    """Radians per count of a position."""
    rad_s: float
    """rad/s per count of a velocity."""
    rad_s2: float
    """rad/s^2 per count of an acceleration."""
    centre: float
    """The position in counts at the joint's offset."""
    still_velocity: int
    """The maximum measured speed at rest."""
    still_counts: int
    """The maximum change of position at rest."""
    arrived: int
    """A joint at rest within this distance of its goal has arrived."""
    near: int
    """A joint within this distance that makes no progress has also arrived, within the limits of its position loop."""


class Sample(Struct, frozen=True, gc=False):
    """One cyclic measurement, in counts."""

    position: int
    velocity: int
    effort: int
    at_ns: int


class Goal(Struct, frozen=True, gc=False):
    """Goal position and maximum speed, in counts."""

    position: int
    accel: int
    speed: int


class Scale:
    """Converts counts of the device to radians of the joint and back."""

    def __init__(self, joint: Joint, resolution: Resolution) -> None:
        self._sign = -1 if joint.reversed else 1
        self._offset_rad = joint.offset_rad
        self._resolution = resolution

    def counts(self, angle_rad: float) -> float:
        """Returns an angle in counts, not rounded."""
        return self._resolution.centre + (angle_rad - self._offset_rad) * self._sign / self._resolution.rad

    def angle_rad(self, counts: int) -> float:
        """Returns the joint angle of a position."""
        return self._offset_rad + (counts - self._resolution.centre) * self._sign * self._resolution.rad

    def speed_rad_s(self, counts: int) -> float:
        """Returns the joint's speed, with its sign."""
        return counts * self._sign * self._resolution.rad_s

    def load(self, counts: int, full: int) -> float:
        """Returns the effort as a fraction of ``full``, with the joint's sign, at most 1."""
        return max(-1.0, min(1.0, counts * self._sign / full))


class Axis(BusDevice[Sample]):
    """The state of one joint."""

    within_turn: ClassVar[bool] = True
    """Whether its encoder keeps its angle within one turn of the motor without power."""
    zero_remedy: ClassVar[str] = (
        "turn it by hand to where it was, or correct its zero (the vendor's tool, offset_rad), then call enable()"
    )
    """The remedy if its zero may have been lost."""

    def __init__(self, name: str, bus: str, joint: Joint, resolution: Resolution, coupled: Sequence[str] = ()) -> None:
        super().__init__(name, bus, Resource(name, coupled=coupled))
        self.joint = joint
        self.id = joint.id
        self.use(resolution)
        self.remedy = ""
        """The remedy for a fault that the device itself has latched."""
        self.ready = False
        """True after this driver has enabled the joint, with its checks done and its watchdog armed."""
        self.motion: AxisMotion[Any] | None = None
        self.held_counts: int | None = None
        """The position of the last hold command."""
        self.zero = Zero(joint, within_turn=self.within_turn)
        self._doubted_zero = False

    def use(self, resolution: Resolution) -> None:
        """Uses a resolution: limits and ranges are in its counts."""
        joint = self.joint
        self.resolution = resolution
        self.scale = Scale(joint, resolution)
        ends = sorted((self.scale.counts(joint.min_rad), self.scale.counts(joint.max_rad)))
        self.low, self.high = ceil(ends[0] - 0.5), floor(ends[1] + 0.5)  # nearest counts: a file has fewer digits
        self.speed_counts = max(1, floor(joint.max_speed_rad_s / resolution.rad_s))
        self.accel_counts = max(1, floor(joint.max_accel_rad_s2 / resolution.rad_s2))

    def note(self, sample: Sample, now_ns: int) -> None:
        """Stores a cyclic measurement, and compares its zero.

        Its time is that of its request. The joint may have moved until now, if this thread stood still meanwhile.
        """
        before, self.sample = self.sample, sample
        self._compare_zero(sample, (now_ns - before.at_ns) / 1e9 if before is not None else 0.0)
        resting = abs(sample.velocity) <= self.resolution.still_velocity and (
            before is not None and abs(sample.position - before.position) <= self.resolution.still_counts
        )
        self.still = self.still + 1 if resting else 0
        self.misses = 0

    @property
    @abstractmethod
    def may_hold_torque(self) -> bool:
        """True if torque is on or unknown."""

    @abstractmethod
    def state(self, now_ns: int, stale_after_ns: int) -> MotorState:
        """Returns the newest measurement.

        Raises:
            DeviceSilent: the measurement is too old.
        """

    def tell_moving(self) -> None:
        """Sets ``resource.moving`` from measurements and commands; turning by hand does not count."""
        under_way = self.motion is not None or self.halting_since_ns > 0
        if under_way or not (self.silent or self.doubted):
            self.resource.moving = under_way or (self.still < _AT_REST and self.may_hold_torque)
        if not (self.silent or self.doubted) and (under_way or not self.still):
            measured = 0 if self.sample is None else abs(self.sample.velocity) * self.resolution.rad_s
            self.zero.moving(self.joint.max_speed_rad_s if under_way else measured)

    @property
    def moved_since_held(self) -> bool:
        """Whether a measurement after the last hold command shows motion."""
        return not self.silent and not self.still and self.sample is not None and self.sample.at_ns > self.held_ns

    def hold_counts(self, now_ns: int, blind_ns: int) -> int | None:
        """Returns where to hold: the measured position, or, if that is old, the position expected from the motion.

        A joint without an answer for ``blind_ns`` has stopped by itself, no farther than it could move in that time. A
        joint that was not measured since its last hold command stays there, as going back would be motion.
        """
        sample = self.sample
        if sample is None:
            return None
        age_s = (now_ns - sample.at_ns) / 1e9
        if self.motion is None and sample.at_ns <= self.held_ns and self.held_counts is not None:
            return self.held_counts
        if self.motion is None or age_s < 0.05:
            return sample.position
        goal = self.motion.goal_of(self)
        travelled = sample.velocity * self.resolution.rad_s / self.resolution.rad * min(age_s, blind_ns / 1e9)
        low, high = sorted((sample.position, goal))
        return round(max(low, min(high, sample.position + travelled)))

    def check_goal(self, counts: int) -> None:
        """Runs the last check of a goal before it is sent.

        Raises:
            LimitExceeded: the goal is outside the joint's range.
        """
        if not self.low <= counts <= self.high:
            joint, value = self.joint, self.scale.angle_rad(counts)
            raise LimitExceeded(what=self.name, value=value, lower=joint.min_rad, upper=joint.max_rad, unit="rad")

    def check_usable(self, now_ns: int, stale_after_ns: int) -> Sample:
        """Returns the newest measurement if the joint may be commanded.

        Raises:
            DeviceSilent: the joint does not answer.
            DeviceFault: a fault is latched.
        """
        self.check_zero()
        if self.fault:
            raise self.fault_error()
        return self.fresh(now_ns, stale_after_ns)

    def _compare_zero(self, sample: Sample, elapsed_s: float) -> None:
        angle_rad = self.scale.angle_rad(sample.position)
        self.zero.measured(angle_rad, elapsed_s)
        if not self._doubted_zero and (doubt := self.zero.doubt(angle_rad)):
            self.doubt_zero(doubt)
        self._doubted_zero = self.zero.in_doubt

    def doubt_zero(self, doubt: str) -> None:
        """Makes the joint unusable, whatever other fault it had, as it may be elsewhere than it reports."""
        self.fault, self.ready = doubt, False

    def check_zero(self, position: int | None = None) -> None:
        """Raises ``DeviceFault`` with both angles if the joint's zero may have been lost.

        It compares a position that was read just now, or the newest measurement.
        """
        if position is not None:
            self.zero.measured(self.scale.angle_rad(position), 0.0)
        elif self.sample is not None:
            position = self.sample.position
        if position is not None and (doubt := self.zero.doubt(self.scale.angle_rad(position))):
            raise self._fault_error(doubt, self.zero_remedy)

    def fresh(self, now_ns: int, stale_after_ns: int) -> Sample:
        """Returns the last measurement. Its age alone decides: a joint just found silent has one that is recent."""
        if self.sample is None or self.age_ns(now_ns) > stale_after_ns:
            raise self.silent_error(now_ns)
        return self.sample

    def fault_error(self, fault: str = "") -> DeviceFault:
        remedy = "remove the cause, then call enable()"
        if not fault and self.zero.in_doubt:
            remedy = self.zero_remedy
        elif not fault and self.remedy:
            remedy = self.remedy
        return self._fault_error(fault or self.fault, remedy)

    def _fault_error(self, fault: str, remedy: str) -> DeviceFault:
        return DeviceFault(device=self.name, bus=self.bus, fault=fault, remedy=remedy)

    def measured(
        self,
        sample: Sample,
        now_ns: int,
        *,
        load: float,
        enabled: bool,
        temperature_c: float | None,
        voltage_v: float | None,
    ) -> MotorState:
        """Returns a state with this measurement."""
        age_s = (now_ns - sample.at_ns) / 1e9
        return MotorState(
            name=self.name,
            position_rad=self.scale.angle_rad(sample.position),
            velocity_rad_s=self.scale.speed_rad_s(sample.velocity),
            load=load,
            temperature_c=temperature_c,
            voltage_v=voltage_v,
            enabled=enabled,
            moving=self.motion is not None or self.still == 0,
            fault=self.fault,
            measured_at=time.monotonic() - age_s,
            age_s=age_s,
        )


class AxisMotion(AwaitedJob[AxisT]):
    """A motion of one or more joints, as far as a joint knows it."""

    permit: Permit

    def goal_of(self, axis: AxisT) -> int:
        """Returns a joint's goal, in counts."""
        raise NotImplementedError

    def watch(self, now_ns: int) -> None:
        """Checks the newest measurements, and ends the motion if it is over or must not continue."""
        raise NotImplementedError
