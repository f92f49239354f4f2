"""One joint as the bus thread knows it: what was read last, how it is, and how counts become radians."""

import struct
from collections.abc import Sequence
from math import ceil, floor
from typing import TYPE_CHECKING, Final

from msgspec import Struct

from trade import Resource
from trade.errors import DeviceFault, DeviceSilent, LimitExceeded
from trade_drivers.dynamixel import _table as table
from trade_drivers.robotfile import Joint

if TYPE_CHECKING:
    from trade_drivers.dynamixel._motion import Motion

__all__ = ["CYCLIC", "SLOW", "Axis", "Health", "Sample", "Scale"]

CYCLIC: Final = (table.PRESENT_LOAD.address, table.PRESENT_POSITION.end - table.PRESENT_LOAD.address)
"""Address and size of what is read of every joint in every cycle: effort, velocity, position."""
SLOW: Final = (table.TORQUE_ENABLE.address, table.TEMPERATURE.end - table.TORQUE_ENABLE.address)
"""Address and size of what is read of one joint at a time: everything from torque to temperature."""
_CYCLIC_LAYOUT: Final = struct.Struct("<hii")
_STILL_VELOCITY: Final = 1
_STILL_COUNTS: Final = 1
_AT_REST: Final = 2
_TICK_TOLERANCE_MS: Final = 250
_TICK_AMBIGUOUS_MS: Final = 16_000


class Sample(Struct, frozen=True, gc=False):
    """One cyclic measurement, in counts."""

    position: int
    velocity: int
    effort: int
    at_ns: int


class Health(Struct, frozen=True, gc=False):
    """One slow measurement, in counts."""

    torque: bool
    status_level: int
    error: int
    watchdog: int
    tick: int
    moving: bool
    voltage: int
    temperature: int
    at_ns: int

    @classmethod
    def decode(cls, data: bytes, at_ns: int) -> "Health":
        """Out of the bytes of the SLOW block."""
        at = SLOW[0]
        return cls(
            torque=table.TORQUE_ENABLE.decode(data, at) == 1,
            status_level=table.STATUS_RETURN_LEVEL.decode(data, at),
            error=table.HARDWARE_ERROR.decode(data, at),
            watchdog=table.BUS_WATCHDOG.decode(data, at),
            tick=table.REALTIME_TICK.decode(data, at),
            moving=table.MOVING.decode(data, at) == 1,
            voltage=table.INPUT_VOLTAGE.decode(data, at),
            temperature=table.TEMPERATURE.decode(data, at),
            at_ns=at_ns,
        )

    def restarted_since(self, earlier: "Health") -> bool:
        """Whether the device's own clock jumped: it went through a reset in between."""
        elapsed_ms = (self.at_ns - earlier.at_ns) / 1e6
        if elapsed_ms > _TICK_AMBIGUOUS_MS:
            return False
        ahead = (self.tick - earlier.tick - elapsed_ms) % table.TICK_WRAPS_AT
        return min(ahead, table.TICK_WRAPS_AT - ahead) > _TICK_TOLERANCE_MS


class Scale:
    """Counts of the device to radians of the joint and back."""

    def __init__(self, joint: Joint) -> None:
        self._sign = -1 if joint.reversed else 1
        self._offset_rad = joint.offset_rad

    def counts(self, angle_rad: float) -> float:
        """Where an angle lies, in counts; not rounded."""
        return table.CENTRE_COUNTS + (angle_rad - self._offset_rad) * self._sign / table.RAD_PER_COUNT

    def angle_rad(self, counts: int) -> float:
        """The joint angle of a position."""
        return self._offset_rad + (counts - table.CENTRE_COUNTS) * self._sign * table.RAD_PER_COUNT

    def speed_rad_s(self, counts: int) -> float:
        """The joint's speed, with its sign."""
        return counts * self._sign * table.RAD_S_PER_COUNT

    def load(self, counts: int, full: int) -> float:
        """Effort as a fraction of full, with the joint's sign, at most 1."""
        return max(-1.0, min(1.0, counts * self._sign / full))


class Axis:
    """The state of one joint. The bus thread writes it; other threads read whole values."""

    def __init__(self, name: str, bus: str, joint: Joint, coupled: Sequence[str] = ()) -> None:
        self.name = name
        self.resource = Resource(name, coupled=coupled)
        """What locks and stops attach to."""
        self.bus = bus
        """The port, for messages."""
        self.joint = joint
        self.id = joint.id
        self.model = table.BY_MODEL_NAME[joint.model]
        self.scale = Scale(joint)
        ends = sorted((self.scale.counts(joint.min_rad), self.scale.counts(joint.max_rad)))
        self.low, self.high = floor(ends[0]), ceil(ends[1])
        self.speed_counts = max(1, floor(joint.max_speed_rad_s / table.RAD_S_PER_COUNT))
        self.accel_counts = max(1, floor(joint.max_accel_rad_s2 / table.RAD_S2_PER_COUNT))

        self.sample: Sample | None = None
        self.health: Health | None = None
        self.health_due_ns = 0
        self.fault = ""
        self.ready = False
        """Enabled by this driver, which has checked and armed it since."""
        self.motion: Motion | None = None
        self.halting_since_ns = 0
        """When it was told to hold; 0 once it was seen at rest."""
        self.held_ns = 0
        """When it was last told to."""
        self.still = 0
        """Measurements in a row in which it did not move."""

        self.misses = 0
        self.doubted = False
        """It missed an exchange and has not answered a ping since: what it sends may be the answer of before."""
        self.silent = False
        """It used up its retries: it is left out and asked now and then whether it is back."""
        self.probe_at_ns = 0
        self.silent_since_ns = 0

    def take_sample(self, data: bytes, at_ns: int) -> None:
        """Note a cyclic measurement."""
        effort, velocity, position = _CYCLIC_LAYOUT.unpack_from(data)
        before = self.sample
        self.sample = Sample(position, velocity, effort, at_ns)
        resting = abs(velocity) <= _STILL_VELOCITY and (
            before is not None and abs(position - before.position) <= _STILL_COUNTS
        )
        self.still = self.still + 1 if resting else 0
        self.misses = 0

    def take_health(self, health: Health) -> None:
        """Note a slow measurement, and latch what speaks against moving on."""
        before, self.health = self.health, health
        if problem := self._problem(before, health):
            self.fault, self.ready = problem, False

    def _problem(self, before: Health | None, now: Health) -> str:
        if now.error:
            bits = [text for bit, text in table.HARDWARE_ERRORS.items() if now.error & bit]
            return f"hardware error: {', '.join(bits) or hex(now.error)}"
        if now.torque and now.watchdog == table.WATCHDOG_EXPIRED:
            return "its watchdog stopped it, because it heard nothing for too long"
        if self.ready and before is not None and now.restarted_since(before):
            return "its clock jumped: it has restarted, or it hangs; is its supply sound?"
        if self.ready and not now.torque:
            return "its torque went off: it lost power, or its protection switched it off"
        return ""

    @property
    def may_hold_torque(self) -> bool:
        """Torque is on, or nobody knows."""
        return self.health is None or self.health.torque

    def goal_block(self, goal: int, accel: int = 0, speed: int = 0) -> bytes:
        """What goes from profile acceleration to goal position; by default at the joint's limits."""
        return b"".join(
            (
                table.PROFILE_ACCELERATION.encode(accel or self.accel_counts),
                table.PROFILE_VELOCITY.encode(speed or self.speed_counts),
                table.GOAL_POSITION.encode(goal),
            )
        )

    def tell_moving(self) -> None:
        """Let the resource know whether it moves: as last measured or commanded, turned by hand does not count."""
        under_way = self.motion is not None or self.halting_since_ns > 0
        if under_way or not (self.silent or self.doubted):
            self.resource.moving = under_way or (self.still < _AT_REST and self.may_hold_torque)

    @property
    def moved_since_held(self) -> bool:
        """Whether it was measured, since it was last told to hold, and found moving."""
        return not self.silent and not self.still and self.sample is not None and self.sample.at_ns > self.held_ns

    def age_ns(self, now_ns: int) -> int:
        """Age of the newest measurement, or the time it has been silent if there is none."""
        return now_ns - (self.sample.at_ns if self.sample else self.silent_since_ns)

    def hold_counts(self, now_ns: int) -> int | None:
        """Where to hold: where it was measured, or, if that is old, where it must have got to since on its way."""
        sample = self.sample
        if sample is None:
            return None
        age_s = (now_ns - sample.at_ns) / 1e9
        if self.motion is None or age_s < 0.05:
            return sample.position
        goal = self.motion.goal_of(self)
        travelled = sample.velocity * table.RAD_S_PER_COUNT / table.RAD_PER_COUNT * age_s
        low, high = sorted((sample.position, goal))
        return round(max(low, min(high, sample.position + travelled)))

    def check_goal(self, counts: int) -> None:
        """The last look before the wire.

        Raises:
            LimitExceeded: outside the joint's range.
        """
        if not self.low <= counts <= self.high:
            joint, value = self.joint, self.scale.angle_rad(counts)
            raise LimitExceeded(what=self.name, value=value, lower=joint.min_rad, upper=joint.max_rad, unit="rad")

    def check_usable(self, now_ns: int, stale_after_ns: int) -> Sample:
        """The newest measurement, if the joint may be commanded.

        Raises:
            DeviceSilent: it does not answer.
            DeviceFault: a fault is latched.
        """
        if self.fault:
            raise self.faulty()
        return self.fresh(now_ns, stale_after_ns)

    def fresh(self, now_ns: int, stale_after_ns: int) -> Sample:
        """The newest measurement.

        Raises:
            DeviceSilent: it is too old, or there is none.
        """
        if self.sample is None or self.age_ns(now_ns) > stale_after_ns:
            raise self.deaf(now_ns)
        return self.sample

    def deaf(self, now_ns: int) -> DeviceSilent:
        """The error of a joint that does not answer."""
        return DeviceSilent(device=self.name, bus=self.bus, waited_s=self.age_ns(now_ns) / 1e9)

    def faulty(self, fault: str = "") -> DeviceFault:
        """The error of a joint with a fault; by default the latched one."""
        remedy = "remove the cause, then call enable()"
        if not fault and self.health is not None and self.health.error:
            remedy = "let it cool down or free it, switch its power off and on, then call enable()"
        return DeviceFault(device=self.name, bus=self.bus, fault=fault or self.fault, remedy=remedy)
