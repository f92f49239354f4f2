"""The state of one servo on the bus thread: its measurements, and faults that forbid motion."""

import struct
from collections.abc import Sequence
from typing import Final

from trade_drivers.joints import Resolution, Sample
from trade_drivers.joints.serial import Health, ServoAxis
from trade_drivers.vendors.dynamixel import _table as table
from trade_robotfile import Joint

CYCLIC: Final = (table.PRESENT_LOAD.address, table.PRESENT_POSITION.end - table.PRESENT_LOAD.address)
"""Address and size of the block read from each joint in each cycle: effort, velocity, position."""
SLOW: Final = (table.TORQUE_ENABLE.address, table.TEMPERATURE.end - table.TORQUE_ENABLE.address)
"""Address and size of the slow block, read from one joint at a time: everything from torque to temperature."""
RESOLUTION: Final = Resolution(
    rad=table.RAD_PER_COUNT,
    rad_s=table.RAD_S_PER_COUNT,
    rad_s2=table.RAD_S2_PER_COUNT,
    centre=table.CENTRE_COUNTS,
    still_velocity=1,
    still_counts=1,
    arrived=4,
    near=20,
)
"""A joint has arrived within 0.35 degrees, or within 1.8 if it makes no more progress."""
_CYCLIC_LAYOUT: Final = struct.Struct("<hii")
_TICK_TOLERANCE_MS: Final = 250
_TICK_AMBIGUOUS_MS: Final = 16_000


class DynamixelHealth(Health, frozen=True, gc=False, kw_only=True):
    """One measurement of the slow block."""

    status_level: int
    watchdog: int
    tick: int

    @classmethod
    def decode(cls, data: bytes, at_ns: int) -> "DynamixelHealth":
        """Decodes the bytes of the SLOW block."""
        at = SLOW[0]
        return cls(
            torque=table.TORQUE_ENABLE.decode(data, at) == 1,
            error=table.HARDWARE_ERROR.decode(data, at),
            moving=table.MOVING.decode(data, at) == 1,
            voltage_v=table.INPUT_VOLTAGE.decode(data, at) * table.INPUT_VOLTAGE.si_per_count,
            temperature_c=table.TEMPERATURE.decode(data, at) * table.TEMPERATURE.si_per_count,
            at_ns=at_ns,
            status_level=table.STATUS_RETURN_LEVEL.decode(data, at),
            watchdog=table.BUS_WATCHDOG.decode(data, at),
            tick=table.REALTIME_TICK.decode(data, at),
        )

    def restarted_since(self, earlier: "DynamixelHealth") -> bool:
        """Returns whether the device's own clock jumped, as it does at a reset."""
        elapsed_ms = (self.at_ns - earlier.at_ns) / 1e6
        if elapsed_ms > _TICK_AMBIGUOUS_MS:
            return False
        ahead = (self.tick - earlier.tick - elapsed_ms) % table.TICK_WRAPS_AT
        return min(ahead, table.TICK_WRAPS_AT - ahead) > _TICK_TOLERANCE_MS


class DynamixelAxis(ServoAxis[DynamixelHealth]):
    """One servo."""

    cyclic = CYCLIC
    slow = SLOW
    settings = (0, table.MIN_POSITION.end)
    homing = table.HOMING_OFFSET
    ends = (table.MIN_POSITION, table.MAX_POSITION)
    error_remedy = "let it cool down or free it, then call enable(), which restarts it"

    def __init__(self, name: str, bus: str, joint: Joint, coupled: Sequence[str] = ()) -> None:
        model = table.BY_MODEL_NAME[joint.model]
        super().__init__(
            name,
            bus,
            joint,
            RESOLUTION,
            coupled,
            model_number=model.number,
            full_effort_counts=model.full_effort_counts,
        )

    def sampled(self, data: bytes, at_ns: int) -> Sample:
        effort, velocity, position = _CYCLIC_LAYOUT.unpack_from(data)
        return Sample(position, velocity, effort, at_ns)

    def examined(self, data: bytes, at_ns: int) -> DynamixelHealth:
        return DynamixelHealth.decode(data, at_ns)

    def problem(self, before: DynamixelHealth | None, now: DynamixelHealth) -> str:
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
