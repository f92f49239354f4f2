"""The vendor-neutral interface of a six-joint arm with its own controller, in SI units."""

from abc import abstractmethod
from typing import Annotated, Literal

from msgspec import Struct

from trade import Meta, service
from trade_drivers.interfaces._motion import Lockable, Speed, Valid
from trade_drivers.interfaces._trajectory import Trajectory, planned
from trade_drivers.motion._plan import JointLimits, Plan, Tolerances

Safety = Literal["normal", "reduced", "protective stop", "recovery", "safeguard stop", "emergency stop", "fault"]


class ArmState(Struct, frozen=True, kw_only=True):
    """The newest measurement of one arm."""

    name: str
    """The arm, such as ``rosie.right``."""
    positions_rad: list[float]
    """From the base to the tool."""
    velocities_rad_s: list[float]
    pose: list[float]
    """The tool's pose in the base frame: x, y, z in m, then a rotation vector in rad."""
    powered: bool
    enabled: bool
    """True if the brakes are released: the arm holds or moves."""
    moving: bool
    freedrive: bool
    """True if the arm can be moved by hand."""
    safety: Safety
    speed_scaling: float
    """The fraction of the commanded speed at which motions run."""
    fault: str = ""
    """Why the arm refuses to move; empty if it does not."""
    remedy: str = ""
    """What to do about the fault."""
    measured_at: float
    """When the driver measured this: ``time.monotonic()`` of its process."""
    age_s: float
    """Age of the measurement."""


class ArmLimits(Struct, frozen=True, kw_only=True):
    """The limits for commands to an arm, from the robot file."""

    name: str
    joints: list[JointLimits]
    """From the base to the tool."""
    max_speed_m_s: float
    """The maximum speed of the tool on a straight line."""
    max_accel_m_s2: float
    poses: dict[str, list[float]]
    """Joint angles in rad, by name of the pose."""


Angles = Annotated[list[float], Meta(description="six joint angles in rad, from the base to the tool, within limits()")]
Pose = Annotated[list[float], Meta(description="x, y, z in m and a rotation vector in rad, in the frame of the base")]
ToolSpeed = Annotated[float, Meta(gt=0, description="speed of the tool in m/s; by default the maximum of limits()")]
Fraction = Annotated[float, Meta(gt=0, le=1, description="fraction of the commanded speed")]


class Arm(Lockable):
    """One arm. It is locked and stopped as a whole; its joints cannot be commanded separately.

    Every service raises ``DeviceSilent`` instead of using outdated values if the controller has sent nothing new for
    too long. Only the services named after them switch power and brakes.
    """

    @service(effect="read")
    @abstractmethod
    def state(self) -> ArmState:
        """Returns angles, speeds, pose and safety state, with the time of measurement.

        Raises:
            DeviceSilent: the newest measurement is older than the bus allows.
        """

    @service(effect="read")
    @abstractmethod
    def limits(self) -> ArmLimits:
        """Returns the limits for commands to this arm (ranges, speeds, accelerations) and its named poses."""

    @service(effect="read")
    def safety_state(self) -> Safety:
        """Returns the state of the controller's safety system."""
        return self.state().safety

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def move_joints(self, positions_rad: Angles, speed_rad_s: Speed | None = None) -> list[float]:
        """Moves in joint space, all joints arriving together, and returns the angles measured at rest.

        Raises:
            LimitExceeded: outside limits(); nothing was sent. A joint outside its range may move back inside.
            InvalidArgument: the values are not six finite numbers.
            MotionStopped: stop(), another move, or the call's deadline ended the move; the arm was stopped.
            DeviceFault: the power is off, the brakes are on, or the safety system stopped the arm.
            DeviceSilent: the controller does not answer.
            DeadlineExceeded: the deadline passed before anything was sent; the command will not run.
        """

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def move_line(self, pose: Pose, speed_m_s: ToolSpeed | None = None) -> list[float]:
        """Moves the tool in a straight line and returns the pose measured at rest.

        Before the move starts, the controller computes the joint angles along the line, every 5 cm and 0.2 rad. A joint
        that would leave its range raises LimitExceeded, a line out of reach InvalidArgument. Then nothing moves, and
        any previous motion has been stopped. A joint measured outside its range ends the move. Singularities, joint
        speeds near them, and collisions with the arm or with obstacles are not checked.
        """

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def move_to_pose(self, name: str, speed_rad_s: Speed | None = None) -> list[float]:
        """Moves to a named pose of limits(), as ``move_joints`` does; InvalidArgument lists the names."""

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def servo(self, positions_rad: Angles, valid_s: Valid = 0.2) -> None:
        """Follows a stream of angles: each set-point is valid for ``valid_s`` seconds, then the arm stops.

        Each joint moves to its own goal within the speed and acceleration of limits(). Returns once it is sent.
        """

    @service(effect="actuate", cancel="stop")
    def follow(self, trajectory: Trajectory, tolerances: Tolerances | None = None) -> list[float]:
        """Follows a trajectory of angles, as ``JointGroup.follow`` does; joints are named as in limits()."""
        return self.stream(planned(trajectory, tolerances or Tolerances(), self.limits().joints))

    @abstractmethod
    def stream(self, plan: Plan) -> list[float]:
        """Executes a plan that follow() has checked; not a service. See ``JointGroup.stream``."""

    @service(effect="stop")
    @abstractmethod
    def stop(self) -> None:
        """Ends any motion, program and freedrive, holds, and returns once at rest. Earlier commands are dropped.

        Raises:
            DeviceSilent: the stop was sent, but the arm did not report whether it is at rest.
            DeviceFault: the stop was sent, but the arm is still moving.
        """

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def freedrive(self, on: bool) -> None:
        """Lets people move the arm by hand until a call with False, a stop, or the end of the caller's session."""

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def set_speed_scaling(self, fraction: Fraction) -> None:
        """Scales the speed of motions down, including the current one.

        A trajectory does not wait for the arm: it ends with ``ToleranceExceeded`` if the arm falls too far behind.
        """

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def unlock_protective_stop(self) -> None:
        """Ends a protective stop after a person has examined its cause; nothing moves.

        Raises:
            DeviceFault: there is no protective stop, or it is too recent: the controller requires a few seconds.
        """

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def power_on(self) -> None:
        """Switches the arm's power on and waits for it; the brakes stay on. No other service does this."""

    @service(effect="actuate", cancel="stop")
    @abstractmethod
    def release_brakes(self) -> None:
        """Releases the brakes of a powered arm and waits until it holds itself; its joints move slightly.

        Raises:
            DeviceFault: the power is off, or the safety system has stopped the arm.
        """
