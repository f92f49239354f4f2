"""The vendor-neutral interfaces of motors, joint groups and grippers, in SI units."""

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
    """The newest measurement of one joint."""

    name: str
    """The joint, such as ``rosie.neck.pan``."""
    position_rad: float
    velocity_rad_s: float
    load: float
    """Effort as a fraction of the motor's maximum, -1 to 1; negative in the negative direction of the joint."""
    temperature_c: float | None
    """None if the device does not report it."""
    voltage_v: float | None
    """None if the device does not report it."""
    enabled: bool
    """True if torque is on: the joint holds or moves. False: it can be turned by hand."""
    moving: bool
    fault: str = ""
    """Why the joint refuses to move until it is enabled again; empty if it does not."""
    measured_at: float
    """When the driver measured position, velocity and load: ``time.monotonic()`` of its process."""
    age_s: float
    """Age of the measurement."""


class GripperState(Struct, frozen=True, kw_only=True):
    """The newest measurement of one gripper."""

    name: str
    """The gripper, such as ``rosie.left.hand``."""
    width_m: float
    """Distance between the fingers."""
    speed_m_s: float
    """Rate of change of the width; negative while closing."""
    force_n: float
    """The last commanded grip force; no supported gripper measures the force."""
    current_a: float
    """Current of the motor."""
    holding: Literal["", "outside", "inside"]
    """Where an object is held: between the fingers, or around them. Empty: none was found, or it was lost."""
    activated: bool
    """True if the fingers have found their end stops; before that, the gripper cannot move."""
    moving: bool
    fault: str = ""
    """Why the gripper refuses to move; empty if it does not."""
    measured_at: float
    """When the driver measured this: ``time.monotonic()`` of its process."""
    age_s: float
    """Age of the measurement."""


class GripperLimits(Struct, frozen=True, kw_only=True):
    """The limits for commands to a gripper, from the robot file and the device."""

    name: str
    min_width_m: float
    max_width_m: float
    min_speed_m_s: float
    max_speed_m_s: float
    min_force_n: float
    max_force_n: float


Position = Annotated[float, Meta(description="joint angle in rad, within limits()")]
Members = Mapping[str, Sequence[str]]
Velocity = Annotated[float, Meta(description="speed in rad/s with the joint's sign, within limits(); 0 holds still")]
Valid = Annotated[float, Meta(gt=0, le=LONGEST_VALID_S, description="seconds until it expires unless it is renewed")]
Speed = Annotated[float, Meta(gt=0, description="maximum speed in rad/s; by default the joint's limit")]


class Lockable(ABC):
    """A device that locks, fences and stops apply to."""

    members: Members = MappingProxyType({})
    """The devices of each group of the robot, from the robot file; a lock of a group is a lock of all of them."""

    @property
    @abstractmethod
    def resources(self) -> tuple[Resource, ...]:
        """The device's resource, named after it; a group returns the resource objects of its joints' motors."""


class Motor(Lockable):
    """One joint with a position drive.

    Every service raises ``DeviceSilent`` instead of using outdated values if the device has not answered for too long.
    """

    @service(effect="read")
    @abstractmethod
    def state(self) -> MotorState:
        """Returns position, velocity, load and health, with the time of measurement.

        Raises:
            DeviceSilent: the newest measurement is older than the bus allows.
        """

    @service(effect="read")
    @abstractmethod
    def limits(self) -> JointLimits:
        """Returns the limits for commands to this joint: range, speed and acceleration."""

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def move_to(self, position_rad: Position, speed_rad_s: Speed | None = None) -> float:
        """Moves to an angle and returns the measured angle once at rest; enables a relaxed joint first.

        Raises:
            LimitExceeded: outside limits(); nothing was sent. A joint outside its range may move back inside.
            InvalidArgument: the value is not a finite number.
            MotionStopped: stop(), another move, or the call's deadline ended the move; the joint was stopped. A move
                ends up to 0.1 s before its deadline, so that this answer still arrives in time.
            DeviceFault: the device reports a fault, or the joint does not move; the driver commanded it to hold.
            DeviceSilent: the device does not answer.
            DeadlineExceeded: the deadline passed before anything was sent; the command will not run.
        """

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def set_velocity(self, velocity_rad_s: Velocity, valid_s: Valid = 0.2) -> None:
        """Turns at a speed for ``valid_s`` seconds, then ramps to a stop unless it is called again before.

        Enables a relaxed joint first, and returns once the command is sent. The joint brakes before the end of its
        range and stops there. A refused call renews nothing.

        Raises:
            LimitExceeded: the speed is outside limits() or the device's range, or moves a joint that is outside its
                range further out.
            InvalidArgument: the speed is not a finite number, or ``valid_s`` is out of range.
            MotionStopped, DeviceFault, DeviceSilent, DeadlineExceeded: as with move_to().
        """

    @service(effect="stop")
    @abstractmethod
    def stop(self) -> None:
        """Ends any motion, holds, and returns once the joint is at rest. Earlier commands are dropped.

        Raises:
            DeviceSilent: the stop was sent, but the joint did not report whether it is at rest.
            DeviceFault: the stop was sent, but the joint is still moving.
        """

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def enable(self) -> None:
        """Switches torque on at the measured position; clears a latched fault and an expired watchdog.

        Raises:
            DeviceFault: the device has a hardware error or refuses the command.
            DeviceSilent: the device does not answer.
            DeadlineExceeded: the deadline passed before torque was on.
        """

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def relax(self) -> None:
        """Switches torque off: the joint can be turned by hand, and falls under load.

        Raises:
            DeviceSilent: the device does not answer.
            DeadlineExceeded: the deadline passed before it was sent.
        """


class JointGroup(Lockable):
    """Joints that are commanded together, with values in the order of ``joints()``. Errors are those of ``Motor``."""

    @service(effect="read")
    @abstractmethod
    def joints(self) -> list[str]:
        """Returns the names of the joints, in the order of all values."""

    @service(effect="read")
    @abstractmethod
    def state(self) -> list[MotorState]:
        """Returns the state of each joint; raises an error if one of them is offline."""

    @service(effect="read")
    @abstractmethod
    def limits(self) -> list[JointLimits]:
        """Returns the limits of each joint."""

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def move_to(self, positions_rad: list[Position], speed_rad_s: Speed | None = None) -> list[float]:
        """Moves all joints so that they start and arrive together, and returns the angles measured at rest.

        ``speed_rad_s`` limits each joint. If one is refused, stopped, faulty or offline, all are stopped.
        """

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def servo(self, positions_rad: list[Position], valid_s: Valid = 0.2) -> None:
        """Follows a stream of positions: each set-point is valid for ``valid_s`` seconds, then all joints stop.

        Each joint moves to its own goal at its limits of speed and acceleration. Returns once it is sent.
        """

    @service(effect="actuate", cancel="stop")
    def follow(self, trajectory: Trajectory, tolerances: Tolerances | None = None) -> list[float]:
        """Follows a trajectory and returns the measured angles once at rest at its end.

        The driver checks the whole trajectory before it sends anything, and enables relaxed joints first. In each
        cycle, the bus thread sends the set-points that are due. The motion ends if the caller dies or cancels it.
        Another move of a joint takes over immediately: this call ends with ``MotionStopped``, and the other joints
        hold. To take over in motion, start the new trajectory with the current angles and velocities. The call's
        progress is a ``FollowProgress``.

        Args:
            trajectory: angles in rad and, if given, speeds in rad/s over time in seconds.
            tolerances: how far the joints may be off; by default those of ``Tolerances``.

        Raises:
            LimitExceeded: an angle, speed or acceleration is outside limits(), also between the points; nothing was
                sent. A joint that is outside its range may begin there and move back inside.
            InvalidArgument: other joints, times that do not increase, no rest at the end, non-finite numbers, or more
                time than the call's deadline leaves; nothing was sent.
            ToleranceExceeded: a joint is not where the trajectory begins, left it, or did not come to rest at its end;
                all joints hold.
            ConfigurationError: the bus is too slow for trajectories of its devices; nothing was sent.
            MotionStopped, DeviceFault, DeviceSilent, DeadlineExceeded: as with a motor's move_to().
        """
        return self.stream(planned(trajectory, tolerances or Tolerances(), self.limits()))

    @abstractmethod
    def stream(self, plan: Plan) -> list[float]:
        """Executes a plan that follow() has checked; not a service. A driver does this:

        - enable relaxed joints, check that each joint is within ``start_rad`` of ``curve.at(0)``, end any other motion
          of them, and hold; then call ``plan.course.ready(now_ns)``;
        - in each cycle, after the permit's gate, send the set-points for ``plan.course.elapsed_s(now_ns)``, which stays
          below zero until all buses are ready;
        - in each cycle, hold and raise if ``plan.course.failed`` is set, a joint is farther off than ``path_rad``, or
          the previous cycle was more than 0.2 s ago;
        - call ``plan.course.note(joint, error_rad)``, and call ``plan.course.report(now_ns)`` several times a second on
          the thread of the service;
        - return the angles at rest, or raise the errors of follow().
        """

    @service(effect="stop")
    @abstractmethod
    def stop(self) -> None:
        """Ends the motion of all joints, holds, and returns once all are at rest."""

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def enable(self) -> None:
        """Switches the torque of all joints on at their measured positions."""

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def relax(self) -> None:
        """Switches the torque of all joints off."""


Width = Annotated[float, Meta(description="distance between the fingers in m, within limits()")]
FingerSpeed = Annotated[
    float, Meta(gt=0, description="speed of the fingers in m/s, within limits(); by default the maximum")
]
Force = Annotated[float, Meta(gt=0, description="grip force in N, within limits(); by default the maximum")]


class Gripper(Lockable):
    """One gripper with two fingers that move together.

    Every service raises ``DeviceSilent`` instead of using outdated values if the device has not answered for too long.
    """

    @service(effect="read")
    @abstractmethod
    def state(self) -> GripperState:
        """Returns width, held object and health, with the time of measurement.

        Raises:
            DeviceSilent: the newest measurement is older than the bus allows.
        """

    @service(effect="read")
    @abstractmethod
    def limits(self) -> GripperLimits:
        """Returns the limits for commands to this gripper: range, speeds and forces."""

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def activate(self) -> GripperState:
        """Moves the fingers through their whole range to find their end stops: a held object falls.

        Clears the device's fault. No driver activates a gripper by itself. Does nothing to one that is activated and
        has no fault.

        Raises:
            MotionStopped: stop() or the call's deadline ended the activation; the gripper is not activated.
            DeviceFault: the activation failed; the fault says why.
            DeviceSilent: the device does not answer.
            DeadlineExceeded: the deadline passed before anything was sent; the command will not run.
        """

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def move_to(
        self, width_m: Width, speed_m_s: FingerSpeed | None = None, force_n: Force | None = None
    ) -> GripperState:
        """Moves the fingers until they are at rest at this width or hold an object; the result says which.

        The gripper keeps pressing on a held object, and follows it, until it is moved or stopped.

        Raises:
            LimitExceeded: outside limits(); nothing was sent.
            InvalidArgument: a value is not a finite number.
            MotionStopped: stop(), another move, or the call's deadline ended the move; the fingers were stopped. A
                move ends up to 0.1 s before its deadline, so that this answer still arrives in time.
            DeviceFault: the gripper is not activated or has a fault, or its fingers do not move; they were stopped.
            DeviceSilent: the device does not answer.
            DeadlineExceeded: the deadline passed before anything was sent; the command will not run.
        """

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def open(self, speed_m_s: FingerSpeed | None = None) -> GripperState:
        """Opens to the maximum width, as ``move_to`` does; releases a held object."""

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def close(self, speed_m_s: FingerSpeed | None = None, force_n: Force | None = None) -> GripperState:
        """Closes to the minimum width, as ``move_to`` does: grips an object between the fingers."""

    @service(effect="stop")
    @abstractmethod
    def stop(self) -> None:
        """Ends any motion or activation and returns once the fingers are at rest. Earlier commands are dropped.

        The fingers then keep their position: they no longer follow a held object.

        Raises:
            DeviceSilent: the stop was sent, but the gripper did not report whether it is at rest.
            DeviceFault: the stop was sent, but the gripper is still moving.
        """

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def clear_fault(self) -> None:
        """Resets the device: clears its faults without motion; it must be activated again afterwards.

        Raises:
            DeviceFault: the fault persists.
            DeviceSilent: the device does not answer.
            DeadlineExceeded: the deadline passed before it was sent.
        """
