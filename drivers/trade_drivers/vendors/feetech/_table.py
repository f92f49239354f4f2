"""The memory table of STS servos: registers as data, with their conversion to SI units.

Sources: addresses and sizes from Feetech's "STS memory table" and, independently of it, rustypot's table of the
STS3215; units from the same memory table. Negative numbers are sign and magnitude, not two's complement.
"""

from enum import Enum
from math import tau
from typing import Final

from msgspec import Struct

RAD_PER_COUNT: Final = tau / 4096
STEPS_PER_SPEED: Final = 10
"""Steps/s in one count of speed; slower motion looks like rest."""
RAD_S_PER_COUNT: Final = STEPS_PER_SPEED * RAD_PER_COUNT
RAD_S2_PER_COUNT: Final = 100 * RAD_PER_COUNT
MOST_ACCELERATION: Final = 254


class Access(Enum):
    """Access to a register, and how long a write lasts."""

    READ = "read only"
    RAM = "read and write; back to its default at power-up"
    EEPROM = "kept without power if it was written while register 55 was 0, else until power-off only"


class Register(Struct, frozen=True):
    """One item of the memory table."""

    address: int
    size: int
    si_per_count: float = 1.0
    unit: str = ""
    access: Access = Access.READ
    sign_bit: int | None = None

    @property
    def end(self) -> int:
        """The address after the register."""
        return self.address + self.size

    def signed(self, raw: int) -> int:
        """Returns the counts of an unsigned register value."""
        if self.sign_bit is None or raw < 1 << self.sign_bit:
            return raw
        return -(raw & (1 << self.sign_bit) - 1)

    def decode(self, data: bytes, start: int = 0) -> int:
        """Returns the counts from a block of bytes read from address ``start``."""
        at = self.address - start
        return self.signed(int.from_bytes(data[at : at + self.size], "little"))

    def encode(self, counts: int) -> bytes:
        """Returns the bytes of a number of counts; raises OverflowError if they do not fit."""
        if counts >= 0 and self.sign_bit is None:
            return counts.to_bytes(self.size, "little")
        if self.sign_bit is None or abs(counts) >> self.sign_bit:
            raise OverflowError(f"{counts} does not fit into register {self.address}")
        return (abs(counts) | (counts < 0) << self.sign_bit).to_bytes(self.size, "little")


_EEPROM, _RAM = Access.EEPROM, Access.RAM

MAJOR: Final = Register(0, 1)
MINOR: Final = Register(1, 1)
"""Both of the firmware."""
END: Final = Register(2, 1)
MODEL_NUMBER: Final = Register(3, 2)
ID: Final = Register(5, 1, access=_EEPROM)
BAUD: Final = Register(6, 1, access=_EEPROM)
STATUS_LEVEL: Final = Register(8, 1, access=_EEPROM)
MIN_ANGLE: Final = Register(9, 2, si_per_count=RAD_PER_COUNT, unit="rad", access=_EEPROM)
MAX_ANGLE: Final = Register(11, 2, si_per_count=RAD_PER_COUNT, unit="rad", access=_EEPROM)
PHASE: Final = Register(18, 1, access=_EEPROM)
UNLOAD: Final = Register(19, 1, access=_EEPROM)
"""The ``STATUS_BITS`` for which the servo switches its torque off by itself."""
HOMING_OFFSET: Final = Register(31, 2, si_per_count=RAD_PER_COUNT, unit="rad", access=_EEPROM, sign_bit=11)
MODE: Final = Register(33, 1, access=_EEPROM)

TORQUE: Final = Register(40, 1, access=_RAM)
ACCELERATION: Final = Register(41, 1, si_per_count=RAD_S2_PER_COUNT, unit="rad/s2", access=_RAM)
GOAL_POSITION: Final = Register(42, 2, si_per_count=RAD_PER_COUNT, unit="rad", access=_RAM, sign_bit=15)
GOAL_TIME: Final = Register(44, 2, si_per_count=0.001, unit="s", access=_RAM)
GOAL_SPEED: Final = Register(46, 2, si_per_count=RAD_PER_COUNT, unit="rad/s", access=_RAM, sign_bit=15)
LOCK: Final = Register(55, 1, access=_RAM)
"""1: writes to EEPROM registers last only until power-off."""
PRESENT_POSITION: Final = Register(56, 2, si_per_count=RAD_PER_COUNT, unit="rad", sign_bit=15)
PRESENT_SPEED: Final = Register(58, 2, si_per_count=RAD_PER_COUNT, unit="rad/s", sign_bit=15)
PRESENT_LOAD: Final = Register(60, 2, si_per_count=0.001, unit="of full duty", sign_bit=10)
VOLTAGE: Final = Register(62, 1, si_per_count=0.1, unit="V")
TEMPERATURE: Final = Register(63, 1, si_per_count=1.0, unit="degC")
WRITE_FLAG: Final = Register(64, 1)
STATUS: Final = Register(65, 1)
MOVING: Final = Register(66, 1)

OVERHEAD: Final = 6
"""Bytes of a packet without parameters."""
BAUD_CODES: Final = {1_000_000: 0, 500_000: 1, 250_000: 2, 128_000: 3, 115_200: 4}
"""Values of register 6 for each rate; sources disagree on the slower ones."""
POSITION_MODE: Final = 0
CENTRE_COUNTS: Final = 2048
FULL_LOAD: Final = 1000
TORQUE_ON: Final = 1
"""128 would make the present position the centre; never written."""
SPEED_IN_STEPS: Final = 0x04
"""Bit of ``PHASE``: speeds are in steps/s, not in units of 0.732 rpm."""
FULL_TURNS: Final = 0x10
"""Bit of ``PHASE``: positions count whole turns."""
DIRECTIONS: Final = 0x81
"""Bits of ``PHASE``: the motor turns, and the encoder counts, in the other direction."""

STATUS_BITS: Final = {
    0x01: "input voltage out of range",
    0x02: "encoder fault",
    0x04: "overheating",
    0x08: "over-current",
    0x20: "overload",
}
"""Bits of register 65, and of the status in every answer."""


class Model(Struct, frozen=True):
    """A supported model."""

    name: str
    number: int


MODELS: Final = (
    Model("STS3215", 777),
    Model("STS3250", 2825),  # LeRobot's table of model numbers; it drives it by the same memory table
    Model("STS3095", 2569),  # likewise AlohaMini's
)
"""The models, by the number in register 3; all have the same memory table. A further one is a line here."""
BY_MODEL_NAME: Final = {model.name: model for model in MODELS}
BY_MODEL_NUMBER: Final = {model.number: model for model in MODELS}


def name_of(model_number: int, otherwise: str) -> str:
    """Returns the name of a model."""
    model = BY_MODEL_NUMBER.get(model_number)
    return model.name if model else otherwise


def firmware(data: bytes) -> str:
    """Returns the firmware version from the bytes from address 0."""
    return f"{MAJOR.decode(data)}.{MINOR.decode(data)}"
