"""What a motor, a group of joints and a gripper can do, in SI units, whoever built them."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Annotated, Literal

from msgspec import Struct

from trade import Meta, Resource, service
from trade_drivers._validation import LONGEST_VALID_S
from trade_drivers.interfaces._trajectory import Trajectory, planned
from trade_drivers.motion._plan import JointLimits, Plan, Tolerances

__all__ = ["Gripper", "GripperLimits", "GripperState", "JointGroup", "JointLimits", "Lockable", "Motor", "MotorState"]


class MotorState(Struct, frozen=True, kw_only=True):
    """What was last measured at one joint."""

    name: str
    """The joint, such as ``rosie.neck.pan``."""
    position_rad: float
    velocity_rad_s: float
    load: float
    """Effort as a fraction of the most the motor can give, -1 to 1; negative in the negative direction of the joint."""
    temperature_c: float | None
    """None: the device does not tell."""
    voltage_v: float | None
    """None: the device does not tell."""
    enabled: bool
    """Torque is on: the joint holds or moves; False: it can be turned by hand."""
    moving: bool
    fault: str = ""
    """Why it refuses to move until it is enabled again; empty if it does not."""
    measured_at: float
    """When position, velocity and load were read: ``time.monotonic()`` of the driver's process."""
    age_s: float
    """How long ago that was."""


class GripperState(Struct, frozen=True, kw_only=True):
    """What was last measured at one gripper."""

    name: str
    """The gripper, such as ``rosie.left.hand``."""
    width_m: float
    """Between the fingers."""
    speed_m_s: float
    """How fast the width changes; negative when it closes."""
    force_n: float
    """The force it was last told to grip with; no gripper known here measures it."""
    current_a: float
    """Of its motor."""
    holding: Literal["", "outside", "inside"]
    """An object was met: between the fingers, which close on it, or around them. Empty: none, or it was lost."""
    activated: bool
    """Its fingers have found their stops; without that it cannot be moved."""
    moving: bool
    fault: str = ""
    """Why it refuses to move; empty if it does not."""
    measured_at: float
    """When all this was read: ``time.monotonic()`` of the driver's process."""
    age_s: float
    """How long ago that was."""


class GripperLimits(Struct, frozen=True, kw_only=True):
    """What a gripper may be told, from the robot file and the device."""

    name: str
    min_width_m: float
    max_width_m: float
    min_speed_m_s: float
    max_speed_m_s: float
    min_force_n: float
    max_force_n: float


Position = Annotated[float, Meta(description="joint angle in rad, within limits()")]
Members = Mapping[str, Sequence[str]]
Velocity = Annotated[float, Meta(description="speed in rad/s with the joint's sign, within limits(); 0 stands still")]
Valid = Annotated[float, Meta(gt=0, le=LONGEST_VALID_S, description="seconds after which it ends unless it is renewed")]
Speed = Annotated[float, Meta(gt=0, description="greatest speed in rad/s; by default the joint's limit")]


class Lockable(ABC):
    """A device that locks, fences and stops attach to."""

    members: Members = MappingProxyType({})
    """Who belongs to the groups of its robot, from the robot file; a lock over a group is one over all of them."""

    @property
    @abstractmethod
    def resources(self) -> tuple[Resource, ...]:
        """One, with the name of the device; a group has those of its joints, each the same object as its motor's."""


class Motor(Lockable):
    """One joint with a position drive.

    Everything raises ``DeviceSilent`` when the device has not answered for too long: an old value is no value.
    """

    @service(effect="read")
    @abstractmethod
    def state(self) -> MotorState:
        """Position, velocity, load, health and the time of their measurement.

        Raises:
            DeviceSilent: the newest measurement is older than the bus allows.
        """

    @service(effect="read")
    @abstractmethod
    def limits(self) -> JointLimits:
        """The range, speed and acceleration this joint may be commanded."""

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def move_to(self, position_rad: Position, speed_rad_s: Speed | None = None) -> float:
        """Move to an angle and return, once at rest there, the angle measured; a relaxed joint is enabled first.

        Raises:
            LimitExceeded: outside of limits(); nothing was sent. Moving back inside is allowed from outside.
            InvalidArgument: not a finite number.
            MotionStopped: stop(), another move, or the call's deadline came first; the joint was stopped. For its
                deadline a move ends up to 0.1 s early, so that this answer is still in time.
            DeviceFault: the device reports a fault, or it does not move; it was told to hold.
            DeviceSilent: the device does not answer.
            DeadlineExceeded: the deadline passed before anything was sent; nothing will be.
        """

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def set_velocity(self, velocity_rad_s: Velocity, valid_s: Valid = 0.2) -> None:
        """Turn at a speed for ``valid_s`` seconds, then ramp to a stop, unless it is called again before.

        Returns once the device was told; a relaxed joint is enabled first. The joint brakes before it comes to the end
        of its range and stands there. A call that is refused renews nothing.

        Raises:
            LimitExceeded: faster or slower than limits() and the device allow, or outwards from outside the range.
            InvalidArgument: not a finite number, or a time that is none.
            MotionStopped, DeviceFault, DeviceSilent, DeadlineExceeded: as with move_to().
        """

    @service(effect="stop")
    @abstractmethod
    def stop(self) -> None:
        """End any motion and hold; returns once the joint is at rest. Commands admitted earlier are dropped.

        Raises:
            DeviceSilent: told to stop, but nobody heard whether it did.
            DeviceFault: told to stop, but it is still moving.
        """

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def enable(self) -> None:
        """Switch torque on, holding where the joint is; clears an expired watchdog and the latched fault.

        Raises:
            DeviceFault: the device has a hardware error or refuses.
            DeviceSilent: the device does not answer.
            DeadlineExceeded: the deadline passed before torque was on.
        """

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def relax(self) -> None:
        """Switch torque off: the joint can be turned by hand, and falls if something pulls it.

        Raises:
            DeviceSilent: the device does not answer.
            DeadlineExceeded: the deadline passed before it was sent.
        """


class JointGroup(Lockable):
    """Joints that are commanded together; values are in the order of ``joints()``. Errors are those of ``Motor``."""

    @service(effect="read")
    @abstractmethod
    def joints(self) -> list[str]:
        """The names of the joints, in the order of all values."""

    @service(effect="read")
    @abstractmethod
    def state(self) -> list[MotorState]:
        """The state of every joint; one silent joint makes it an error."""

    @service(effect="read")
    @abstractmethod
    def limits(self) -> list[JointLimits]:
        """The limits of every joint."""

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def move_to(self, positions_rad: list[Position], speed_rad_s: Speed | None = None) -> list[float]:
        """Move all joints so that they start together and arrive together; the angles measured at rest.

        ``speed_rad_s`` bounds every joint. If one is refused, stopped, faulty or silent, all are stopped.
        """

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def servo(self, positions_rad: list[Position], valid_s: Valid = 0.2) -> None:
        """Follow positions that are given again and again: each holds for ``valid_s`` seconds, then all joints stop.

        Every joint goes for its own at its limits of speed and acceleration; returns once the devices were told.
        """

    @service(effect="actuate", cancel="stop")
    def follow(self, trajectory: Trajectory, tolerances: Tolerances | None = None) -> list[float]:
        """Go through angles at given times and return, once at rest at the last, the angles measured.

        All of it is checked before anything is sent; relaxed joints are enabled first. The driver's own thread sends
        what is due in each of its cycles: nothing is asked of the caller meanwhile, but it must live. Cancelled, it
        stops. Another move of a joint takes over at once: this call ends with ``MotionStopped``, and the joints that
        are left hold. A trajectory that is to take over from another one smoothly begins with the angles and
        velocities of that moment. Its progress is a ``FollowProgress``.

        Args:
            trajectory: angles in rad and, if given, speeds in rad/s over time in seconds.
            tolerances: how far from it the joints may be; by default those of ``Tolerances``.

        Raises:
            LimitExceeded: an angle, speed or acceleration is beyond limits(), also between the points; nothing was
                sent. It may begin outside of the range of a joint that stands there, and come back in.
            InvalidArgument: other joints, times that do not rise, no end at rest, numbers that are not finite, or more
                time than its call has; nothing was sent.
            ToleranceExceeded: a joint is not where the trajectory begins; or it left it on the way, or did not come to
                rest at its end: then all hold.
            ConfigurationError: its bus is too slow for that kind of device; nothing was sent.
            MotionStopped, DeviceFault, DeviceSilent, DeadlineExceeded: as with a motor's move_to().
        """
        return self.stream(planned(trajectory, tolerances or Tolerances(), self.limits()))

    @abstractmethod
    def stream(self, plan: Plan) -> list[float]:
        """Carry out what follow() has checked; no service. For drivers:

        - enable what is relaxed, see that each joint is within ``start_rad`` of ``curve.at(0)``, and take over from
          whatever moves them, holding there; then call ``plan.course.ready(now_ns)``;
        - in every cycle, after the permit's gate, send what is due at ``plan.course.elapsed_s(now_ns)``, which stays
          below zero until all buses are ready;
        - in every cycle, look whether ``plan.course.failed`` is set, a joint is farther off than ``path_rad``, or more
          than 0.2 s have passed since the cycle before: then hold, and raise;
        - tell ``plan.course.note(joint, error_rad)``, and call ``plan.course.report(now_ns)`` several times a second on
          the thread of the service;
        - return the angles at rest, or raise as follow() says.
        """

    @service(effect="stop")
    @abstractmethod
    def stop(self) -> None:
        """End the motion of every joint and hold; returns once all are at rest."""

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def enable(self) -> None:
        """Switch the torque of every joint on, holding where they are."""

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def relax(self) -> None:
        """Switch the torque of every joint off."""


Width = Annotated[float, Meta(description="between the fingers in m, within limits()")]
FingerSpeed = Annotated[
    float, Meta(gt=0, description="of the fingers in m/s, within limits(); by default the greatest")
]
Force = Annotated[float, Meta(gt=0, description="to grip with in N, within limits(); by default the greatest")]


class Gripper(Lockable):
    """One gripper with two fingers that move together.

    Everything raises ``DeviceSilent`` when the device has not answered for too long: an old value is no value.
    """

    @service(effect="read")
    @abstractmethod
    def state(self) -> GripperState:
        """Width, what is held, health and the time of their measurement.

        Raises:
            DeviceSilent: the newest measurement is older than the bus allows.
        """

    @service(effect="read")
    @abstractmethod
    def limits(self) -> GripperLimits:
        """The range, speeds and forces this gripper may be commanded."""

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def activate(self) -> GripperState:
        """Have the fingers find their stops, by moving all the way: what they hold falls. Never done by itself.

        Clears the fault of the device. A gripper that is activated and has no fault is left as it is.

        Raises:
            MotionStopped: stop(), or the call's deadline came first; it is not activated.
            DeviceFault: it did not succeed; the fault says why.
            DeviceSilent: the device does not answer.
            DeadlineExceeded: the deadline passed before anything was sent; nothing will be.
        """

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def move_to(
        self, width_m: Width, speed_m_s: FingerSpeed | None = None, force_n: Force | None = None
    ) -> GripperState:
        """Move the fingers until they are at rest there, or hold something; whether they do is in the answer.

        The gripper goes on pressing on what it holds, and follows it, until it is moved or stopped.

        Raises:
            LimitExceeded: outside of limits(); nothing was sent.
            InvalidArgument: not a finite number.
            MotionStopped: stop(), another move, or the call's deadline came first; the fingers were stopped. For its
                deadline a move ends up to 0.1 s early, so that this answer is still in time.
            DeviceFault: not activated, a fault, or the fingers do not move; they were told to stop.
            DeviceSilent: the device does not answer.
            DeadlineExceeded: the deadline passed before anything was sent; nothing will be.
        """

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def open(self, speed_m_s: FingerSpeed | None = None) -> GripperState:
        """``move_to`` the greatest width; what is held is let go of."""

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def close(self, speed_m_s: FingerSpeed | None = None, force_n: Force | None = None) -> GripperState:
        """``move_to`` the least width: grip what is between the fingers."""

    @service(effect="stop")
    @abstractmethod
    def stop(self) -> None:
        """End any motion, activation too; returns once the fingers are at rest. Commands admitted earlier are dropped.

        From here on the fingers stand: they do not follow what they hold any more.

        Raises:
            DeviceSilent: told to stop, but nobody heard whether it did.
            DeviceFault: told to stop, but it is still moving.
        """

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def clear_fault(self) -> None:
        """Reset the device: its faults are cleared, nothing moves, and it has to be activated again.

        Raises:
            DeviceFault: the fault is still there.
            DeviceSilent: the device does not answer.
            DeadlineExceeded: the deadline passed before it was sent.
        """
