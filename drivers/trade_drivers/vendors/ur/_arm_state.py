"""The state of one arm on the bus thread: its measurement, its safety state and its motion."""

import time
from typing import Final, Protocol

from trade import Resource
from trade.errors import DeviceFault, TradeError
from trade_drivers.bus._cycle import BusDevice
from trade_drivers.interfaces._arm import ArmState, Safety
from trade_drivers.vendors.ur._messages import Sample
from trade_robotfile import Arm

JOINTS: Final = ("base", "shoulder", "elbow", "wrist_1", "wrist_2", "wrist_3")
IDLE: Final = 5
"""``robot_mode`` of an arm that is powered, with its brakes on."""
RUNNING: Final = 7
"""``robot_mode`` of an arm whose brakes are off."""
_POWERED: Final = 1
"""Bits of ``robot_status``."""
_PROGRAM: Final = 2
_PROTECTIVE_STOP: Final = 3
_SAFETY: Final[dict[int, Safety]] = {
    1: "normal",
    2: "reduced",
    _PROTECTIVE_STOP: "protective stop",
    4: "recovery",
    5: "safeguard stop",
    6: "emergency stop",
    7: "emergency stop",
}
_STILL_RAD_S: Final = 0.005
_STILL: Final = 3
"""Consecutive measurements without motion that mean rest."""


class ArmMotion(Protocol):
    """What the exchange needs of a motion."""

    attended_ns: int
    """When it was last checked, by the lasting clock."""

    @property
    def streams(self) -> bool:
        """True for a stream of set-points, which must also be ended after success."""
        ...

    def watch(self, now_ns: int) -> None:
        """Checks the newest measurement, and ends the motion if it is over or must not continue."""

    def finish(self, error: TradeError | None = None) -> None:
        """Passes the outcome to the waiting service."""


class ArmStatus(BusDevice[Sample]):
    """The state of one arm."""

    def __init__(self, name: str, host: str, arm: Arm) -> None:
        super().__init__(name, host, Resource(name))
        self.arm = arm
        self.joints = [f"{name}.{joint}" for joint in JOINTS]
        self.motion: ArmMotion | None = None

    def take(self, sample: Sample) -> None:
        """Stores a measurement."""
        self.still = self.still + 1 if max(abs(speed) for speed in sample.speeds) < _STILL_RAD_S else 0
        self.sample, self.silent = sample, False

    def tell_moving(self) -> None:
        """Sets ``resource.moving`` from the last measurement or command."""
        self.resource.moving = self.motion is not None or self.halting_since_ns > 0 or self.still == 0

    def ended_since(self, since_ns: int) -> bool:
        """Returns whether a later measurement shows that no program runs on the controller."""
        sample = self.sample
        return sample is not None and sample.at_ns > since_ns and not sample.robot_status & _PROGRAM

    def at_rest(self, now_ns: int, stale_after_ns: int) -> bool:
        """Returns whether it is measured at rest without a commanded motion."""
        return self.motion is None and self.still >= _STILL and self.age_ns(now_ns) <= stale_after_ns

    def check_usable(self, now_ns: int, stale_after_ns: int) -> Sample:
        """Returns the newest measurement if the arm may be commanded.

        Raises:
            DeviceSilent: the controller sends nothing new.
            DeviceFault: the arm is stopped by its safety system, without power, or on its brakes.
        """
        sample = self.fresh(now_ns, stale_after_ns)
        if self.fault:
            raise self.fault_error()
        return sample

    @property
    def safety(self) -> Safety:
        """The state of its safety system."""
        return "fault" if self.sample is None else _SAFETY.get(self.sample.safety_mode, "fault")

    @property
    def enabled(self) -> bool:
        """Whether its brakes are released."""
        return self.sample is not None and self.sample.robot_mode == RUNNING

    @property
    def powered(self) -> bool:
        """Whether it has power."""
        return self.sample is not None and bool(self.sample.robot_status & _POWERED)

    @property
    def fault(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride] - nothing latches it
        """Why it cannot be moved; empty if it can."""
        if self.safety not in {"normal", "reduced"}:
            return f"its safety system says: {self.safety}"
        if not self.powered:
            return "its power is off"
        return "" if self.enabled else "its brakes are on"

    @property
    def remedy(self) -> str:
        """The remedy for the fault."""
        if self.safety == "protective stop":
            return "remove the cause, then call unlock_protective_stop()"
        if self.safety not in {"normal", "reduced"}:
            return "remove the cause and release it at the controller"
        if not self.powered:
            return "call power_on() and release_brakes()"
        return "try again, or look at the controller's log" if self.enabled else "call release_brakes()"

    @property
    def slowed(self) -> str:
        """What slows its motions by order; empty if nothing does."""
        fraction = 1.0 if self.sample is None else self.sample.speed_fraction
        return f"its speed slider is at {100 * fraction:.3g} %" if fraction < 1 else ""

    def lag_error(self, fault: str) -> DeviceFault:
        """Returns the error of an arm that is behind, with what slows it."""
        return self.fault_error(f"{fault}; {self.slowed}" if self.slowed else fault)

    def fault_error(self, fault: str = "") -> DeviceFault:
        """Returns the error of an arm that does not follow a command; by default with its current fault."""
        return DeviceFault(device=self.name, bus=self.bus, fault=fault or self.fault, remedy=self.remedy)

    def state(self, now_ns: int, stale_after_ns: int, *, freedrive: bool) -> ArmState:
        """Returns the newest measurement.

        Raises:
            DeviceSilent: the measurement is too old.
        """
        sample = self.fresh(now_ns, stale_after_ns)
        age_s = (now_ns - sample.at_ns) / 1e9
        return ArmState(
            name=self.name,
            positions_rad=sample.positions,
            velocities_rad_s=sample.speeds,
            pose=sample.pose,
            powered=self.powered,
            enabled=self.enabled,
            moving=self.motion is not None or self.still == 0,
            freedrive=freedrive,
            safety=self.safety,
            speed_scaling=sample.speed_fraction,
            fault=self.fault,
            remedy=self.remedy if self.fault else "",
            measured_at=time.monotonic() - age_s,
            age_s=age_s,
        )
