"""One motor as the bus thread knows it: whether it is here, what was asked of it, what speaks against moving on."""

from abc import abstractmethod
from math import isfinite, tau
from typing import Final

from trade_drivers.joints import Axis, Grain, Sample, Unfit
from trade_drivers.robotfile import Joint

__all__ = ["Another", "MotorAxis", "grain_of"]

_STILL_RAD_S: Final = 0.01
_ARRIVED_RAD: Final = 0.004
_NEAR_RAD: Final = 0.03


def grain_of(joint: Joint, rate_hz: float, counts_per_rev: float) -> Grain:
    """What counts of a motor mean: positions in counts, speeds in counts a second, and so on."""
    rad = tau / (counts_per_rev * joint.gear)
    return Grain(
        rad=rad,
        rad_s=rad,
        rad_s2=rad,
        centre=0,
        still_velocity=max(1, round(_STILL_RAD_S / rad)),
        still_counts=max(1, round(_STILL_RAD_S / rate_hz / rad)),
        arrived=max(2, round(_ARRIVED_RAD / rad)),
        near=max(4, round(_NEAR_RAD / rad)),
    )


class Another(Unfit):
    """Another motor than the one the robot file names."""

    def __init__(self, key: str, expected: str, found: str, kind: str = "motor") -> None:
        super().__init__(f"its {key} is {found}, not {expected}: it is another {kind}", f".{key}")
        self.expected, self.found = expected, found


class MotorAxis(Axis):
    """One motor. While it is ``silent`` it is left out; it comes back only after it was looked over."""

    beat_ns = 0
    """When it last said anything by itself, or answered."""
    asked_ns = 0
    """When it was last asked for a measurement that has not come; 0 if it has."""
    since_ns = 0
    """When it was taken on."""
    stranger = False
    """It was taken on just now, and may be moving."""
    hushed = False
    """It is not asked: whether its watchdog notices that is being tried."""

    @property
    @abstractmethod
    def torque(self) -> bool | None:
        """Whether its motor is powered; None while nobody knows."""

    @property
    def may_hold_torque(self) -> bool:
        return self.torque is not False

    def measured_at(self, position: float, velocity: float, effort: float, now_ns: int) -> None:
        """It has told where it is, in counts: the answer to what it was asked last, if it was asked.

        Dated when it was asked, not when it came: a frozen process would take old values for new.
        """
        asked_ns, self.asked_ns = self.asked_ns, 0
        at_ns = now_ns if self.hushed else asked_ns
        if self.silent or not at_ns or not all(map(isfinite, (position, velocity, effort))):
            return
        self.note(Sample(round(position), round(velocity), round(effort), at_ns))

    def latch(self, fault: str) -> None:
        """Note what speaks against moving on, until it is enabled again; the first that says something is kept."""
        self.fault = self.fault or fault
        self.ready = False

    def forget(self, now_ns: int) -> None:
        """Leave it out until it was looked over again."""
        if not self.silent:
            self.silent, self.silent_since_ns = True, now_ns
        self.asked_ns, self.hushed = 0, False

    def welcome(self, now_ns: int) -> None:
        """It is fit and heard."""
        if self.ready:
            self.latch("it was away")
        self.silent, self.silent_since_ns, self.sample = False, now_ns, None
        self.beat_ns = self.since_ns = now_ns
        self.asked_ns, self.stranger = 0, True
