"""The state of one motor on the bus thread: its last frames, its set-point, and faults that forbid motion."""

from collections.abc import Sequence
from math import tau
from struct import error as BadLength  # noqa: N812 - what unpacking raises for another number of bytes
from typing import Final

from trade_drivers.interfaces._motion import MotorState
from trade_drivers.joints import Ramp, Resolution
from trade_drivers.joints.can import MotorAxis
from trade_drivers.vendors.damiao import _frames as frames
from trade_drivers.vendors.damiao import _table as table
from trade_drivers.vendors.damiao._frames import Feedback
from trade_drivers.vendors.damiao._table import MODELS, Register, Status
from trade_robotfile import Joint

COUNTS_PER_RAD: Final = (1 << 16) / tau
"""Counts per radian of the motor's shaft in this driver; frames contain radians."""
_STILL_RAD_S: Final = 0.01
_ARRIVED_RAD: Final = 0.004
_NEAR_RAD: Final = 0.03


def resolution_of(joint: Joint, rate_hz: float) -> Resolution:
    """Returns the resolution, which is limited by that of the frames."""
    ranges = MODELS[joint.model]
    rad = 1 / (COUNTS_PER_RAD * joint.gear)
    position, velocity = 2 * ranges.position_rad / 0xFFFF, 2 * ranges.velocity_rad_s / 0xFFF
    return Resolution(
        rad=rad,
        rad_s=rad,
        rad_s2=rad,
        centre=0,
        still_velocity=round(max(_STILL_RAD_S / rad, 1.5 * velocity * COUNTS_PER_RAD)),
        still_counts=round(max(_STILL_RAD_S / rate_hz / rad, 1.5 * position * COUNTS_PER_RAD)),
        arrived=round(max(_ARRIVED_RAD / rad, 2 * position * COUNTS_PER_RAD)),
        near=round(max(_NEAR_RAD / rad, 4 * position * COUNTS_PER_RAD)),
    )


class DamiaoAxis(MotorAxis):
    """One motor."""

    within_turn = True

    def __init__(self, name: str, bus: str, joint: Joint, rate_hz: float, coupled: Sequence[str] = ()) -> None:
        super().__init__(name, bus, joint, resolution_of(joint, rate_hz), coupled)
        self.ranges = MODELS[joint.model]
        self.master = joint.id + table.MASTER
        self.status: int | None = None
        self.heard_ns = 0
        """When it last sent feedback."""
        self.software: int | None = None
        """The software version when it was attached."""
        self.asks: Register | None = None
        """The requested register."""
        self.answer: float | None = None
        """The answered value of the register."""
        self.course: Ramp | None = None
        """The generator of its set-point in each cycle; None if it gets no set-points."""
        self.easing = 1.0
        """The share of its acceleration used for braking."""
        self.stepped_ns = 0
        """When the last set-point was sent, by the clock of interruptions."""
        self._celsius: float | None = None

    # --- received frames

    def take(self, data: bytes, now_ns: int) -> None:
        """Handles an answer frame: a register if one was requested, otherwise feedback."""
        if self.asks is not None and (answer := frames.answer(data, self.id, self.asks)) is not None:
            self.answer, self.asks = answer, None
            self.beat_ns = now_ns
            return
        try:
            feedback = Feedback.decode(data, self.ranges)
        except BadLength:
            return
        if feedback.nibble != self.id & 0xF:
            return
        self.status, self.beat_ns, self.heard_ns = feedback.status, now_ns, now_ns
        self._celsius = feedback.temperature_c
        self.measured_at(
            feedback.position_rad * COUNTS_PER_RAD,
            feedback.velocity_rad_s * COUNTS_PER_RAD,
            feedback.torque_nm / self.ranges.torque_nm * table.FULL,
            now_ns,
        )
        self._judge()

    def _judge(self) -> None:
        if self.failed:
            self.latch(self.complaint)
        elif self.ready and not self.torque:
            self.latch("its torque went off; has it restarted?")
        else:
            return
        self.course = None

    def doubt_zero(self, doubt: str) -> None:
        super().doubt_zero(doubt)
        self.course = None

    # --- state

    @property
    def failed(self) -> bool:
        """Whether it reports an error, and so has switched its torque off."""
        return self.status not in {None, Status.DISABLED, Status.ENABLED}

    @property
    def complaint(self) -> str:
        """The reported error."""
        known = {status.value: status.name.lower().replace("_", " ") for status in Status}
        return f"status {self.status:X}h: {known.get(self.status or 0, 'unknown')}"

    @property
    def torque(self) -> bool | None:
        return None if self.status is None else self.status == Status.ENABLED

    def forget(self, now_ns: int) -> None:
        super().forget(now_ns)
        self.asks = None

    def welcome(self, now_ns: int) -> None:
        super().welcome(now_ns)
        self.course = None

    def step(self, now_ns: int, period_s: float) -> bytes:
        """Returns the next set-point and its maximum speed, on the motor's shaft."""
        course = self.course
        if course is None:
            raise self.fault_error("it has no set-point")
        elapsed_s = min((now_ns - self.stepped_ns) / 1e9, 2 * period_s)  # after a gap, it continues where it was
        self.stepped_ns = now_ns
        if elapsed_s > 0:
            course.step(elapsed_s)
        fastest = self.joint.max_speed_rad_s * self.joint.gear
        return frames.position_velocity(course.position / COUNTS_PER_RAD, min(fastest, self.ranges.velocity_rad_s))

    def state(self, now_ns: int, stale_after_ns: int) -> MotorState:
        sample = self.fresh(now_ns, stale_after_ns)
        return self.measured(
            sample,
            now_ns,
            load=self.scale.load(sample.effort, table.FULL),
            enabled=self.torque is True,
            temperature_c=self._celsius,
            voltage_v=None,
        )
