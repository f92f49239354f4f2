"""What an arm of six joints with a controller of its own can do, in SI units, whoever built it."""

from abc import abstractmethod
from typing import Annotated, Literal

from msgspec import Struct

from trade import Meta, service
from trade_drivers.interfaces._motion import Lockable, Speed, Valid
from trade_drivers.interfaces._trajectory import Trajectory, planned
from trade_drivers.motion._plan import JointLimits, Plan, Tolerances

__all__ = ["Arm", "ArmLimits", "ArmState", "Safety"]

Safety = Literal["normal", "reduced", "protective stop", "recovery", "safeguard stop", "emergency stop", "fault"]


class ArmState(Struct, frozen=True, kw_only=True):
    """What was last measured at one arm."""

    name: str
    """The arm, such as ``rosie.right``."""
    positions_rad: list[float]
    """From the base to the tool."""
    velocities_rad_s: list[float]
    pose: list[float]
    """Of the tool in the frame of the base: x, y, z in m, then a rotation vector in rad."""
    powered: bool
    enabled: bool
    """Its brakes are released: it holds or moves."""
    moving: bool
    freedrive: bool
    """It can be moved by hand."""
    safety: Safety
    speed_scaling: float
    """The fraction of their speed at which motions are carried out."""
    fault: str = ""
    """Why it refuses to move; empty if it does not."""
    remedy: str = ""
    """What to do about that."""
    measured_at: float
    """When all this was read: ``time.monotonic()`` of the driver's process."""
    age_s: float
    """How long ago that was."""


class ArmLimits(Struct, frozen=True, kw_only=True):
    """What an arm may be told, from the robot file."""

    name: str
    joints: list[JointLimits]
    """From the base to the tool."""
    max_speed_m_s: float
    """Of the tool, on a line."""
    max_accel_m_s2: float
    poses: dict[str, list[float]]
    """Joint angles in rad by the name of the pose."""


Angles = Annotated[list[float], Meta(description="six joint angles in rad, from the base to the tool, within limits()")]
Pose = Annotated[list[float], Meta(description="x, y, z in m and a rotation vector in rad, in the frame of the base")]
ToolSpeed = Annotated[float, Meta(gt=0, description="of the tool in m/s; by default the greatest of limits()")]
Fraction = Annotated[float, Meta(gt=0, le=1, description="of the speed motions are told")]


class Arm(Lockable):
    """One arm. It is one thing to lock and to stop: its joints are not commanded one by one.

    Everything raises ``DeviceSilent`` when the controller has not sent anything new for too long: an old value is no
    value. Power and brakes are switched by the services of that name, and by nothing else.
    """

    @service(effect="read")
    @abstractmethod
    def state(self) -> ArmState:
        """Angles, speeds, pose, safety and the time of their measurement.

        Raises:
            DeviceSilent: the newest measurement is older than the bus allows.
        """

    @service(effect="read")
    @abstractmethod
    def limits(self) -> ArmLimits:
        """The ranges, speeds and accelerations this arm may be commanded, and the poses it knows by name."""

    @service(effect="read")
    def safety_state(self) -> Safety:
        """What the safety system of the controller says."""
        return self.state().safety

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def move_joints(self, positions_rad: Angles, speed_rad_s: Speed | None = None) -> list[float]:
        """Move in joint space, all joints arriving together; the angles measured at rest there.

        Raises:
            LimitExceeded: outside of limits(); nothing was sent. Moving back inside is allowed from outside.
            InvalidArgument: not six finite numbers.
            MotionStopped: stop(), another move, or the call's deadline came first; the arm was stopped.
            DeviceFault: its power is off, its brakes are on, or its safety system stopped it.
            DeviceSilent: the controller does not answer.
            DeadlineExceeded: the deadline passed before anything was sent; nothing will be.
        """

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def move_line(self, pose: Pose, speed_m_s: ToolSpeed | None = None) -> list[float]:
        """Move the tool in a straight line; the pose measured at rest.

        Before it begins, the joint angles along the line are worked out, every 5 cm and 0.2 rad: a joint that would
        leave its range is LimitExceeded, a line that leads out of reach InvalidArgument, and nothing moves (what was
        under way has been stopped by then). A joint that is measured outside all the same ends the move. Nobody looks
        for singularities, how fast joints turn near them, the arm itself or anything else that is in the way.
        """

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def move_to_pose(self, name: str, speed_rad_s: Speed | None = None) -> list[float]:
        """``move_joints`` to a pose of limits(); InvalidArgument names those there are."""

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def servo(self, positions_rad: Angles, valid_s: Valid = 0.2) -> None:
        """Follow angles that are given again and again: each holds for ``valid_s`` seconds, then the arm stops.

        Every joint goes for its own within limits() of speed and acceleration; returns once the controller was told.
        """

    @service(effect="actuate", cancel="stop")
    def follow(self, trajectory: Trajectory, tolerances: Tolerances | None = None) -> list[float]:
        """Go through angles at given times, as ``JointGroup.follow`` does; its joints are named as in limits()."""
        return self.stream(planned(trajectory, tolerances or Tolerances(), self.limits().joints))

    @abstractmethod
    def stream(self, plan: Plan) -> list[float]:
        """Carry out what follow() has checked; no service. As ``JointGroup.stream``."""

    @service(effect="stop")
    @abstractmethod
    def stop(self) -> None:
        """End any motion, program and freedrive, and hold; returns once at rest. Earlier commands are dropped.

        Raises:
            DeviceSilent: told to stop, but nobody heard whether it did.
            DeviceFault: told to stop, but it is still moving.
        """

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def freedrive(self, on: bool) -> None:
        """Let it be moved by hand, until this is called with False, it is stopped, or the caller's session ends."""

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def set_speed_scaling(self, fraction: Fraction) -> None:
        """Have motions carried out slower, also the one under way.

        A trajectory does not wait for the arm: it ends with ``ToleranceExceeded`` if the arm falls behind too far.
        """

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def unlock_protective_stop(self) -> None:
        """End a protective stop, once somebody has looked at its cause; nothing moves.

        Raises:
            DeviceFault: there is none, or it is too early: its controller wants some seconds to pass.
        """

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def power_on(self) -> None:
        """Switch the arm's power on and wait for it; its brakes stay on. No other service does it."""

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def release_brakes(self) -> None:
        """Release the brakes of a powered arm and wait until it holds itself; its joints move a little.

        Raises:
            DeviceFault: its power is off, or it is stopped by its safety system.
        """
