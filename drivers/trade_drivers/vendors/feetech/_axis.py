"""The state of one servo on the bus thread: its measurements, its limited goal, and faults that forbid motion."""

import struct
from collections.abc import Sequence
from typing import Final

from trade_drivers.joints import Goal, Resolution, Sample
from trade_drivers.joints.serial import Health, ServoAxis
from trade_drivers.vendors.feetech import _table as table
from trade_robotfile import Joint

CYCLIC: Final = (table.PRESENT_POSITION.address, table.PRESENT_LOAD.end - table.PRESENT_POSITION.address)
"""Address and size of the block read from each joint in each cycle: position, speed, load."""
SLOW: Final = (table.TORQUE.address, table.MOVING.end - table.TORQUE.address)
"""Address and size of the slow block, read from one joint at a time: everything from torque to the moving flag."""
RESOLUTION: Final = Resolution(
    rad=table.RAD_PER_COUNT,
    rad_s=table.RAD_S_PER_COUNT,
    rad_s2=table.RAD_S2_PER_COUNT,
    centre=table.CENTRE_COUNTS,
    still_velocity=0,
    still_counts=1,
    arrived=4,
    near=20,
)
"""A joint has arrived within 0.35 degrees, or within 1.8 if it makes no more progress."""

_CYCLIC_LAYOUT: Final = struct.Struct("<HHH")


class FeetechHealth(Health, frozen=True, gc=False, kw_only=True):
    """One measurement of the slow block."""

    locked: bool
    """True if writes to EEPROM registers are lost at power-off."""
    position: int

    @classmethod
    def decode(cls, data: bytes, at_ns: int) -> "FeetechHealth":
        """Decodes the bytes of the SLOW block."""
        at = SLOW[0]
        return cls(
            torque=table.TORQUE.decode(data, at) != 0,
            error=table.STATUS.decode(data, at),
            moving=table.MOVING.decode(data, at) != 0,
            voltage_v=table.VOLTAGE.decode(data, at) * table.VOLTAGE.si_per_count,
            temperature_c=table.TEMPERATURE.decode(data, at) * table.TEMPERATURE.si_per_count,
            at_ns=at_ns,
            locked=table.LOCK.decode(data, at) != 0,
            position=table.PRESENT_POSITION.decode(data, at),
        )


class FeetechAxis(ServoAxis[FeetechHealth]):
    """One servo.

    It has no watchdog. So its goal is never farther than it can move in ``lead_s``, plus the braking: ``aim`` is the
    end of the motion, ``sent`` the goal in the servo.
    """

    cyclic = CYCLIC
    slow = SLOW
    settings = (0, table.TORQUE.address)
    homing = table.HOMING_OFFSET
    ends = (table.MIN_ANGLE, table.MAX_ANGLE)
    error_remedy = "let it cool down or free it, then call enable()"

    def __init__(self, name: str, bus: str, joint: Joint, lead_s: float, coupled: Sequence[str] = ()) -> None:
        number = table.BY_MODEL_NAME[joint.model].number
        super().__init__(name, bus, joint, RESOLUTION, coupled, model_number=number, full_effort_counts=table.FULL_LOAD)
        self._lead_s = lead_s
        self.unload = 0
        """The error bits for which the servo is set to switch its torque off."""
        self.aim: Goal | None = None
        self.sent, self.sent_ns = 0, 0
        self._at_rest_ns = int((lead_s + joint.max_speed_rad_s / joint.max_accel_rad_s2) * 1e9)

    def sampled(self, data: bytes, at_ns: int) -> Sample:
        position, speed, load = _CYCLIC_LAYOUT.unpack_from(data)
        return Sample(
            table.PRESENT_POSITION.signed(position),
            round(table.PRESENT_SPEED.signed(speed) / table.STEPS_PER_SPEED),
            table.PRESENT_LOAD.signed(load),
            at_ns,
        )

    def examined(self, data: bytes, at_ns: int) -> FeetechHealth:
        return FeetechHealth.decode(data, at_ns)

    def problem(self, before: FeetechHealth | None, now: FeetechHealth) -> str:  # noqa: ARG002 - it has no clock
        if now.error:
            bits = [text for bit, text in table.STATUS_BITS.items() if now.error & bit]
            return f"status: {', '.join(bits) or hex(now.error)}"
        if self.ready and not now.torque:
            return "its torque went off: it lost power, or another program switched it off"
        return ""

    def step(self, aim: Goal, now_ns: int) -> Goal:
        """Returns the next goal on the way: as far as the servo may move until its next answer is due.

        Raises:
            DeviceSilent: the servo was never measured.
        """
        if self.sample is None:
            raise self.silent_error(now_ns)
        here, resolution = self.sample.position, self.resolution
        speed_rad_s = aim.speed * resolution.rad_s
        lead_rad = speed_rad_s * self._lead_s + speed_rad_s**2 / (2 * aim.accel * resolution.rad_s2)
        lead = max(resolution.near, round(lead_rad / resolution.rad))
        return Goal(max(here - lead, min(here + lead, aim.position)), aim.accel, aim.speed)

    def hold_counts(self, now_ns: int, blind_ns: int) -> int | None:
        """Returns where to hold, as for any joint, but no farther than the last goal, where the servo comes to rest.

        None for a servo in doubt: if its torque is off by now, a goal would switch it on. Also None if it must be at
        rest and has not answered since, as it is unknown whether it received the last goal.
        """
        counts, sample = super().hold_counts(now_ns, blind_ns), self.sample
        if counts is None or sample is None or self.in_doubt:
            return None
        if sample.at_ns <= self.sent_ns < now_ns - self._at_rest_ns:
            return None
        if self.motion is None:
            return counts
        low, high = sorted((sample.position, self.sent))
        return max(low, min(high, counts))
