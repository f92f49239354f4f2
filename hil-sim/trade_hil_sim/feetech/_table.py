"""The memory table of STS servos as data.

Sources: addresses, sizes and defaults from Feetech's "STS memory table", where it gives them; signs as the vendor's
library has them. The drivers keep a table of their own on purpose: a mistake in one of them shows.
"""

from dataclasses import dataclass, replace
from typing import Final

from trade_hil_sim.serial import _registers as registers
from trade_hil_sim.serial._registers import Access
from trade_hil_sim.serial._servo import CENTRE

ACCELERATION_STEPS_S2: Final = 100
EEPROM_BEGINS: Final = 5
RAM_BEGINS: Final = 40
TABLE_ENDS: Final = 87
BAUDS: Final = (1_000_000, 500_000, 250_000, 128_000, 115_200)
"""Register 6 is an index into these; of the slower ones, sources disagree."""


@dataclass(frozen=True, slots=True)
class Register(registers.Register):
    """One item of the memory table."""

    sign_bit: int | None = None

    @property
    def eeprom(self) -> bool:
        """Whether it can survive a loss of power."""
        return EEPROM_BEGINS <= self.address < RAM_BEGINS

    def decode(self, raw: bytes) -> int:
        """The value of its bytes: low byte first, sign and magnitude."""
        number = int.from_bytes(raw, "little")
        if self.sign_bit is None:
            return number
        sign = 1 << self.sign_bit
        return -(number % sign) if number & sign else number % sign

    def encode(self, value: int) -> bytes:
        """Its bytes; surplus bits are cut off."""
        if self.sign_bit is None:
            return (value % (1 << 8 * self.size)).to_bytes(self.size, "little")
        sign = 1 << self.sign_bit
        return (min(abs(value), sign - 1) + (sign if value < 0 else 0)).to_bytes(self.size, "little")


@dataclass(frozen=True, slots=True)
class Model(registers.Model[Register]):
    """One kind of servo."""

    top_speed_counts_s: float
    """The fastest the shaft turns, whatever the registers say."""


READ: Final = Access.READ
WRITE: Final = Access.WRITE

STS3215: Final = Model(
    name="STS3215",
    number=777,
    top_speed_counts_s=3400.0,
    supply_v=7.4,
    registers=(
        Register(0, 1, "firmware_major", READ, 3),
        Register(1, 1, "firmware_minor", READ, 10),
        Register(2, 1, "end", READ, 0),
        Register(3, 2, "model_number", READ, 777),
        Register(5, 1, "id", WRITE, 1, 0, 253),
        Register(6, 1, "baud_rate", WRITE, 0, 0, 4),
        Register(7, 1, "return_delay_time", WRITE, 0, 0, 254),
        Register(8, 1, "status_level", WRITE, 1, 0, 1),
        Register(9, 2, "min_angle", WRITE, 0, 0, 4095),
        Register(11, 2, "max_angle", WRITE, 4095, 0, 4095),
        Register(13, 1, "max_temperature", WRITE, 70, 0, 100),
        Register(14, 1, "max_voltage", WRITE, 80, 0, 254),
        Register(15, 1, "min_voltage", WRITE, 40, 0, 254),
        Register(16, 2, "max_torque", WRITE, 1000, 0, 1000),
        Register(18, 1, "phase", WRITE, 12, 0, 254),
        Register(19, 1, "unload_condition", WRITE, 44, 0, 254),
        Register(20, 1, "led_condition", WRITE, 47, 0, 254),
        Register(21, 1, "p_gain", WRITE, 32, 0, 254),
        Register(22, 1, "d_gain", WRITE, 32, 0, 254),
        Register(23, 1, "i_gain", WRITE, 0, 0, 254),
        Register(24, 2, "min_start_force", WRITE, 16, 0, 1000),
        Register(26, 1, "cw_dead_zone", WRITE, 1, 0, 32),
        Register(27, 1, "ccw_dead_zone", WRITE, 1, 0, 32),
        Register(28, 2, "protection_current", WRITE, 500, 0, 511),
        Register(30, 1, "angular_resolution", WRITE, 1, 1, 100),
        Register(31, 2, "homing_offset", WRITE, 0, -2047, 2047, sign_bit=11),
        Register(33, 1, "mode", WRITE, 0, 0, 3),
        Register(34, 1, "protective_torque", WRITE, 20, 0, 100),
        Register(35, 1, "protection_time", WRITE, 200, 0, 254),
        Register(36, 1, "overload_torque", WRITE, 80, 0, 100),
        Register(37, 1, "speed_p_gain", WRITE, 10, 0, 254),
        Register(38, 1, "over_current_time", WRITE, 200, 0, 254),
        Register(39, 1, "speed_i_gain", WRITE, 10, 0, 254),
        Register(40, 1, "torque_enable", WRITE, 0, 0, 128),
        Register(41, 1, "acceleration", WRITE, 0, 0, 254),
        Register(42, 2, "goal_position", WRITE, CENTRE, -32_766, 32_766, sign_bit=15),
        Register(44, 2, "goal_time", WRITE, 0, -1000, 1000, sign_bit=10),
        Register(46, 2, "goal_speed", WRITE, 0, -32_766, 32_766, sign_bit=15),
        Register(48, 2, "torque_limit", WRITE, 1000, 0, 1000),
        Register(55, 1, "lock", WRITE, 1, 0, 1),
        Register(56, 2, "present_position", READ, CENTRE, sign_bit=15),
        Register(58, 2, "present_speed", READ, sign_bit=15),
        Register(60, 2, "present_load", READ, sign_bit=10),
        Register(62, 1, "present_voltage", READ),
        Register(63, 1, "present_temperature", READ),
        Register(64, 1, "async_write_flag", READ),
        Register(65, 1, "status", READ),
        Register(66, 1, "moving", READ),
        Register(69, 2, "present_current", READ, sign_bit=15),
        Register(80, 1, "moving_threshold", READ, 10),
        Register(81, 1, "dts", READ, 10),
        Register(82, 1, "speed_unit_factor", READ, 1),
        Register(83, 1, "hts", READ),
        Register(84, 1, "max_speed", READ, 68),
        Register(85, 1, "max_acceleration", READ, 254),
        Register(86, 1, "acceleration_factor", READ, 1),
    ),
)


def _likewise(name: str, number: int) -> Model:
    """A model with the same memory table and the same motor."""
    renamed = {"model_number": number}
    registers = [replace(one, default=renamed.get(one.name, one.default)) for one in STS3215.registers]
    return replace(STS3215, name=name, number=number, registers=tuple(registers))


MODELS: Final = {model.name: model for model in (STS3215, _likewise("STS3250", 2825), _likewise("STS3095", 2569))}
