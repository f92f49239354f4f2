"""Control tables of X and MX servos on protocol 2.0: registers as data, with their conversion to SI units.

Sources: ROBOTIS e-Manual, the models' pages, "Control Table of EEPROM Area" and "Control Table of RAM Area". All have
the same addresses up to 147, which is all that is used here; behind that they differ: where indirect data begin on an
X330 even depends on its firmware. Register 126 is a load or a current, in the model's own unit.
"""

from enum import Enum
from math import tau
from typing import Final, Literal

from msgspec import Struct

RAD_PER_COUNT: Final = tau / 4096
RAD_S_PER_COUNT: Final = 0.229 * tau / 60
RAD_S2_PER_COUNT: Final = 214.577 * tau / 3600


class Access(Enum):
    """Access to a register."""

    READ = "read only"
    RAM = "read and write; back to its default at power-up"
    EEPROM = "kept without power; written only while torque is off"


Kind = Literal["u1", "u2", "u4", "i2", "i4"]


class Register(Struct, frozen=True):
    """One item of a control table."""

    address: int
    kind: Kind
    si_per_count: float = 1.0
    unit: str = ""
    access: Access = Access.READ

    @property
    def size(self) -> int:
        """Size in bytes."""
        return int(self.kind[1])

    @property
    def end(self) -> int:
        """The address after the register."""
        return self.address + self.size

    def decode(self, data: bytes, start: int = 0) -> int:
        """Returns the counts from a block of bytes from address ``start``; two's complement if the table says so."""
        at = self.address - start
        return int.from_bytes(data[at : at + self.size], "little", signed=self.kind[0] == "i")

    def encode(self, counts: int) -> bytes:
        """Returns the bytes of a number of counts; raises OverflowError if they do not fit."""
        return counts.to_bytes(self.size, "little", signed=self.kind[0] == "i")


_EEPROM, _RAM = Access.EEPROM, Access.RAM

MODEL_NUMBER: Final = Register(0, "u2")
FIRMWARE: Final = Register(6, "u1")
ID: Final = Register(7, "u1", access=_EEPROM)
BAUD: Final = Register(8, "u1", access=_EEPROM)
RETURN_DELAY: Final = Register(9, "u1", si_per_count=2e-6, unit="s", access=_EEPROM)
DRIVE_MODE: Final = Register(10, "u1", access=_EEPROM)
OPERATING_MODE: Final = Register(11, "u1", access=_EEPROM)
SHADOW_ID: Final = Register(12, "u1", access=_EEPROM)
HOMING_OFFSET: Final = Register(20, "i4", si_per_count=RAD_PER_COUNT, unit="rad", access=_EEPROM)
VELOCITY_LIMIT: Final = Register(44, "u4", si_per_count=RAD_S_PER_COUNT, unit="rad/s", access=_EEPROM)
MAX_POSITION: Final = Register(48, "u4", si_per_count=RAD_PER_COUNT, unit="rad", access=_EEPROM)
MIN_POSITION: Final = Register(52, "u4", si_per_count=RAD_PER_COUNT, unit="rad", access=_EEPROM)

TORQUE_ENABLE: Final = Register(64, "u1", access=_RAM)
STATUS_RETURN_LEVEL: Final = Register(68, "u1", access=_RAM)
HARDWARE_ERROR: Final = Register(70, "u1")
BUS_WATCHDOG: Final = Register(98, "u1", si_per_count=0.020, unit="s", access=_RAM)
PROFILE_ACCELERATION: Final = Register(108, "u4", si_per_count=RAD_S2_PER_COUNT, unit="rad/s2", access=_RAM)
PROFILE_VELOCITY: Final = Register(112, "u4", si_per_count=RAD_S_PER_COUNT, unit="rad/s", access=_RAM)
GOAL_POSITION: Final = Register(116, "i4", si_per_count=RAD_PER_COUNT, unit="rad", access=_RAM)
REALTIME_TICK: Final = Register(120, "u2", si_per_count=0.001, unit="s")
MOVING: Final = Register(122, "u1")
PRESENT_LOAD: Final = Register(126, "i2", si_per_count=0.001, unit="of full load")
PRESENT_CURRENT: Final = Register(126, "i2", si_per_count=0.00269, unit="A")
PRESENT_CURRENT_24V: Final = Register(126, "i2", si_per_count=0.00134, unit="A")
"""The register of the XH430-V."""
PRESENT_CURRENT_330: Final = Register(126, "i2", si_per_count=0.001, unit="A")
PRESENT_CURRENT_MX: Final = Register(126, "i2", si_per_count=0.00336, unit="A")
PRESENT_VELOCITY: Final = Register(128, "i4", si_per_count=RAD_S_PER_COUNT, unit="rad/s")
PRESENT_POSITION: Final = Register(132, "i4", si_per_count=RAD_PER_COUNT, unit="rad")
VELOCITY_TRAJECTORY: Final = Register(136, "i4", si_per_count=RAD_S_PER_COUNT, unit="rad/s")
POSITION_TRAJECTORY: Final = Register(140, "i4", si_per_count=RAD_PER_COUNT, unit="rad")
INPUT_VOLTAGE: Final = Register(144, "u2", si_per_count=0.1, unit="V")
TEMPERATURE: Final = Register(146, "u1", si_per_count=1.0, unit="degC")

BAUD_CODES: Final = {9_600: 0, 57_600: 1, 115_200: 2, 1_000_000: 3, 2_000_000: 4, 3_000_000: 5, 4_000_000: 6}
"""Values of register 8 for each rate; 7 is 4.5 Mbaud, which the library does not support."""
POSITION_MODE: Final = 3
CENTRE_COUNTS: Final = 2048
TICK_WRAPS_AT: Final = 32768
WATCHDOG_EXPIRED: Final = 255
"""Value of register 98 after the watchdog has expired; goal registers are read-only until 0 is written to it."""

HARDWARE_ERRORS: Final = {
    0x01: "input voltage out of range",
    0x04: "overheating",
    0x08: "encoder fault",
    0x10: "electrical shock",
    0x20: "overload",
}
"""Bits of register 70."""
STATUS_ERRORS: Final = {
    1: "could not carry it out",
    2: "does not know the instruction",
    3: "received a damaged packet",
    4: "data range: the value is out of range, or its watchdog has locked the goal registers",
    5: "data length: too few bytes for the register",
    6: "data limit: the value is outside the device's own limit register",
    7: "access: the register is read-only, or kept without power and torque is on",
}
"""Numbers in a status packet's error field (e-Manual, "DYNAMIXEL Protocol 2.0", "Error")."""


class Model(Struct, frozen=True):
    """The properties in which the supported models differ."""

    name: str
    number: int
    effort: Register
    """The register at address 126."""
    full_effort_counts: int
    """Counts of ``effort`` at full load, the reference for fractions."""


_FULL_LOAD: Final = 1000


def _with_load(number: int, name: str) -> Model:
    return Model(name, number, PRESENT_LOAD, _FULL_LOAD)


def _with_current(number: int, name: str, limit: int, effort: Register = PRESENT_CURRENT) -> Model:
    """Returns a model whose ``limit`` is the maximum of its current limit, register 38."""
    return Model(name, number, effort, limit)


MODELS: Final = (
    _with_load(1060, "XL430-W250"),
    _with_load(1070, "XC430-W150"),
    _with_load(1080, "XC430-W240"),
    _with_load(1090, "2XL430-W250"),
    _with_load(1160, "2XC430-W250"),
    _with_current(1190, "XL330-M077", 1750, PRESENT_CURRENT_330),
    _with_current(1200, "XL330-M288", 1750, PRESENT_CURRENT_330),
    _with_current(1210, "XC330-T181", 910, PRESENT_CURRENT_330),
    _with_current(1220, "XC330-T288", 910, PRESENT_CURRENT_330),
    _with_current(1230, "XC330-M181", 2352, PRESENT_CURRENT_330),
    _with_current(1240, "XC330-M288", 2352, PRESENT_CURRENT_330),
    _with_current(1020, "XM430-W350", 1193),
    _with_current(1030, "XM430-W210", 1193),
    _with_current(1120, "XM540-W270", 2047),
    _with_current(1130, "XM540-W150", 2047),
    _with_current(1000, "XH430-W350", 648),
    _with_current(1010, "XH430-W210", 648),
    _with_current(1040, "XH430-V350", 689, PRESENT_CURRENT_24V),
    _with_current(1050, "XH430-V210", 689, PRESENT_CURRENT_24V),
    _with_current(1100, "XH540-W270", 2047),
    _with_current(1110, "XH540-W150", 2047),
    _with_current(1140, "XH540-V270", 1188),  # an older page has 2047; it draws what the V150 does
    _with_current(1150, "XH540-V150", 1188),
    _with_current(1001, "XD430-T350", 648),
    _with_current(1011, "XD430-T210", 648),
    _with_current(1101, "XD540-T270", 2047),
    _with_current(1111, "XD540-T150", 2047),
    _with_current(1270, "XW430-T333", 2047),
    _with_current(1280, "XW430-T200", 2047),
    _with_current(1170, "XW540-T260", 2047),
    _with_current(1180, "XW540-T140", 2047),
    _with_current(1310, "XW540-H260", 1188),
    _with_load(30, "MX-28"),
    _with_current(311, "MX-64", 1941, PRESENT_CURRENT_MX),
    _with_current(321, "MX-106", 2047, PRESENT_CURRENT_MX),
)
BY_MODEL_NAME: Final = {model.name: model for model in MODELS}
BY_MODEL_NUMBER: Final = {model.number: model for model in MODELS}


def name_of(model_number: int, otherwise: str) -> str:
    """Returns the name of a model."""
    model = BY_MODEL_NUMBER.get(model_number)
    return model.name if model else otherwise


def firmware(data: bytes) -> str:
    """Returns the firmware version from the bytes from address 0."""
    return str(FIRMWARE.decode(data))
