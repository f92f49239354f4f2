"""The state of one motor on the bus thread: its presence, its open request, and its faults."""

from abc import abstractmethod
from math import isfinite, tau
from typing import Final

from trade_drivers.joints import Axis, DeviceUnusable, Resolution, Sample
from trade_robotfile import Joint

STILL_RAD_S: Final = 0.01
"""The maximum speed at rest."""
_LARGEST: Final = 2**31
"""Counts beyond any position, as drives count in 32 bits, and as a float of 32 bits no longer resolves one."""
_ARRIVED_RAD: Final = 0.004
_NEAR_RAD: Final = 0.03


def resolution_of(joint: Joint, rate_hz: float, counts_per_rev: float) -> Resolution:
    """Returns the resolution of a motor: positions in counts, speeds in counts per second, and so on."""
    rad = tau / (counts_per_rev * joint.gear)
    return Resolution(
        rad=rad,
        rad_s=rad,
        rad_s2=rad,
        centre=0,
        still_velocity=max(1, round(STILL_RAD_S / rad)),
        still_counts=max(1, round(STILL_RAD_S / rate_hz / rad)),
        arrived=max(2, round(_ARRIVED_RAD / rad)),
        near=max(4, round(_NEAR_RAD / rad)),
    )


class DifferentMotor(DeviceUnusable):
    """The motor is another one than in the robot file."""

    def __init__(self, key: str, expected: str, found: str, kind: str = "motor") -> None:
        super().__init__(f"its {key} is {found}, not {expected}: it is another {kind}", f".{key}")
        self.expected, self.found = expected, found


def check_keys(axis: "MotorAxis", kind: str, unit: str) -> None:
    """Raises ``DeviceUnusable`` for keys that such motors do not have, and for a zero that is not known."""
    joint = axis.joint
    if joint.counts_per_rev is not None:
        raise DeviceUnusable(f"{kind} reports {unit}, not counts; leave this key out", ".counts_per_rev")
    if joint.homing_counts:
        raise DeviceUnusable("is for servos; leave this key out", ".homing_counts")
    if joint.serial_number is not None:
        raise DeviceUnusable(f"{kind} reports no serial number here; leave this key out", ".serial_number")
    _check_zero_known(axis)


def _check_zero_known(axis: "MotorAxis") -> None:
    """Raises ``DeviceUnusable`` for a range over a turn of the motor if the file does not say how zero is known."""
    joint, turn_rad = axis.joint, tau / axis.joint.gear
    wide_rad = joint.max_rad - joint.min_rad
    if joint.zero is None and wide_rad > turn_rad:
        raise DeviceUnusable(
            f"missing: the range is {wide_rad:.4g} rad, but without power {joint.model} keeps its place within "
            f'{turn_rad:.4g} rad at most, a turn of the motor; write zero = "last" if the joint stays where it is '
            'without power, or zero = "kept" if the device keeps or finds its zero',
            ".zero",
        )


class MotorAxis(Axis):
    """One motor. While it is ``silent``, it is left out, and returns only after it was checked."""

    within_turn = False
    zero_remedy = (
        "turn it by hand to where it was, or correct its zero (home(), the vendor's tool, offset_rad), then call "
        'enable(); a device that keeps its zero is zero = "kept" in the robot file'
    )
    beat_ns = 0
    """When a frame of the motor was last received."""
    asked_ns = 0
    """When the open request for a measurement was sent; 0 if there is none."""
    since_ns = 0
    """When the motor was accepted."""
    unowned = False
    """True directly after it was accepted, when it may be moving by no client's order."""
    unfed = False
    """True while the driver sends it nothing, to test its watchdog."""

    @property
    @abstractmethod
    def torque(self) -> bool | None:
        """Whether torque is on; None if unknown."""

    @property
    def may_hold_torque(self) -> bool:
        return self.torque is not False

    def measured_at(self, position: float, velocity: float, effort: float, now_ns: int) -> None:
        """Stores a measurement in counts, which answers the open request, if there is one.

        Its time is that of the request, not of the arrival, as a frozen process would take old values for new.
        """
        asked_ns, self.asked_ns = self.asked_ns, 0
        at_ns = now_ns if self.unfed else asked_ns
        values = (position, velocity, effort)
        if not all(isfinite(value) and abs(value) <= _LARGEST for value in values):
            given = ", ".join(f"{value:.6g}" for value in values)
            self.why_silent = (
                f"it reports an impossible position, speed or effort ({given}, in its driver's counts), as while its "
                "encoder is not ready; check its encoder and calibration"
            )
            return
        self.why_silent = ""
        if self.silent or not at_ns:
            return
        self.note(Sample(round(position), round(velocity), round(effort), at_ns), now_ns)

    def latch(self, fault: str) -> None:
        """Latches a fault until the motor is enabled again; the first one is kept."""
        self.fault = self.fault or fault
        self.ready = False

    def forget(self, now_ns: int) -> None:
        """Leaves the motor out until it was checked again."""
        self.tell_moving()
        if not self.silent:
            self.silent, self.silent_since_ns = True, now_ns
        self.asked_ns, self.unfed = 0, False

    def welcome(self, now_ns: int) -> None:
        """Accepts a motor that answers and has passed its checks."""
        if self.ready:
            self.latch("it was away")
        self.silent, self.silent_since_ns, self.sample = False, now_ns, None
        self.beat_ns = self.since_ns = now_ns
        self.asked_ns, self.unowned = 0, True
        self.zero.interrupted()
