"""One servo as the bus thread knows it: what is read of it, and what speaks against moving on."""

import struct
from collections.abc import Sequence
from typing import Final

from msgspec import Struct

from trade_drivers._interfaces import MotorState
from trade_drivers.dynamixel import _table as table
from trade_drivers.joints import Axis, Grain, Sample
from trade_drivers.robotfile import Joint

__all__ = ["CYCLIC", "GRAIN", "SLOW", "Health", "ServoAxis"]

CYCLIC: Final = (table.PRESENT_LOAD.address, table.PRESENT_POSITION.end - table.PRESENT_LOAD.address)
"""Address and size of what is read of every joint in every cycle: effort, velocity, position."""
SLOW: Final = (table.TORQUE_ENABLE.address, table.TEMPERATURE.end - table.TORQUE_ENABLE.address)
"""Address and size of what is read of one joint at a time: everything from torque to temperature."""
GRAIN: Final = Grain(
    rad=table.RAD_PER_COUNT,
    rad_s=table.RAD_S_PER_COUNT,
    rad_s2=table.RAD_S2_PER_COUNT,
    centre=table.CENTRE_COUNTS,
    still_velocity=1,
    still_counts=1,
    arrived=4,
    near=20,
)
"""Arrived within 0.35 degrees, or 1.8 if it comes no closer."""
_CYCLIC_LAYOUT: Final = struct.Struct("<hii")
_HEALTH_STALE_NS: Final = 2_000_000_000
_POWER_CYCLE: Final = "let it cool down or free it, switch its power off and on, then call enable()"
_TICK_TOLERANCE_MS: Final = 250
_TICK_AMBIGUOUS_MS: Final = 16_000


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


class ServoAxis(Axis):
    """One servo."""

    def __init__(self, name: str, bus: str, joint: Joint, coupled: Sequence[str] = ()) -> None:
        super().__init__(name, bus, joint, GRAIN, coupled)
        self.model = table.BY_MODEL_NAME[joint.model]
        self.health: Health | None = None
        self.health_due_ns = 0

    def take_sample(self, data: bytes, at_ns: int) -> None:
        """Note a cyclic measurement."""
        effort, velocity, position = _CYCLIC_LAYOUT.unpack_from(data)
        self.note(Sample(position, velocity, effort, at_ns))

    def take_health(self, health: Health) -> None:
        """Note a slow measurement, and latch what speaks against moving on."""
        before, self.health = self.health, health
        self.remedy = _POWER_CYCLE if health.error else ""
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

    def state(self, now_ns: int, stale_after_ns: int) -> MotorState:
        sample, health = self.fresh(now_ns, stale_after_ns), self.health
        if health is None or now_ns - health.at_ns > _HEALTH_STALE_NS:
            raise self.deaf(now_ns)
        return self.measured(
            sample,
            now_ns,
            load=self.scale.load(sample.effort, self.model.full_effort_counts),
            enabled=health.torque,
            temperature_c=health.temperature * table.TEMPERATURE.si_per_count,
            voltage_v=health.voltage * table.INPUT_VOLTAGE.si_per_count,
        )
