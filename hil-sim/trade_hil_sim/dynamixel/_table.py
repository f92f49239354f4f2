"""Control tables of the X series as data.

Sources: ROBOTIS e-Manual, the models' pages (control table of EEPROM area, of RAM area). The drivers keep a table of
their own on purpose: a mistake in one of them shows.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from trade_hil_sim.serial import _registers as registers
from trade_hil_sim.serial._registers import Access
from trade_hil_sim.serial._servo import CENTRE, COUNTS_PER_TURN

__all__ = ["ACCELERATION_COUNTS_S2", "VELOCITY_COUNTS_S", "Access", "Indirect", "Mode", "Model", "Register"]
__all__ += ["gain", "x_series"]

VELOCITY_COUNTS_S: Final = 0.229 * COUNTS_PER_TURN / 60
"""Counts per second in one unit of velocity, 0.229 rev/min."""
ACCELERATION_COUNTS_S2: Final = 214.577 * COUNTS_PER_TURN / 3600
"""Counts per second squared in one unit of profile acceleration, 214.577 rev/min^2."""
RAM_BEGINS: Final = 64
EXTENDED_RANGE: Final = 1_048_575
"""Goal positions in extended position mode: 256 turns either way."""
BAUDS: Final = (9600, 57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000)
"""Register 8 is an index into these."""


class Mode(IntEnum):
    """Operating mode, register 11."""

    CURRENT = 0
    VELOCITY = 1
    POSITION = 3
    EXTENDED_POSITION = 4
    CURRENT_BASED_POSITION = 5
    PWM = 16

    @property
    def seeks_position(self) -> bool:
        """Whether it moves to the goal position."""
        return self in {Mode.POSITION, Mode.EXTENDED_POSITION, Mode.CURRENT_BASED_POSITION}

    @property
    def goal(self) -> str:
        """The register that starts a motion."""
        names = {Mode.CURRENT: "goal_current", Mode.VELOCITY: "goal_velocity", Mode.PWM: "goal_pwm"}
        return names.get(self, "goal_position")


@dataclass(frozen=True, slots=True)
class Register(registers.Register):
    """One item of the control table."""

    signed: bool = False

    @property
    def eeprom(self) -> bool:
        """Whether it survives power loss, and is locked while torque is on."""
        return self.address < RAM_BEGINS

    def decode(self, raw: bytes) -> int:
        """The value of its bytes: low byte first, two's complement."""
        return int.from_bytes(raw, "little", signed=self.signed)

    def encode(self, value: int) -> bytes:
        """Its bytes; surplus bits are cut off."""
        return (value & (1 << 8 * self.size) - 1).to_bytes(self.size, "little")


@dataclass(frozen=True, slots=True)
class Indirect:
    """Registers that stand for others, byte by byte (e-Manual, "Indirect Address, Indirect Data")."""

    first: int
    """The number of the first one."""
    count: int
    address_at: int
    data_at: int


@dataclass(frozen=True, slots=True)
class Model(registers.Model[Register]):
    """One kind of servo."""

    firmware: int
    modes: frozenset[int]
    no_load_rpm: float
    """At the voltage it is made for, e-Manual "Specifications"."""
    indirect: tuple[Indirect, ...]

    @property
    def ends(self) -> int:
        """The address behind its last register."""
        return self.registers[-1].address + self.registers[-1].size

    @property
    def full_effort_counts(self) -> int:
        """The value of the register at address 126 at full effort."""
        return self.by_name["current_limit"].default if "current_limit" in self.by_name else FULL_LOAD

    @property
    def top_speed_counts_s(self) -> float:
        """The fastest the shaft turns, whatever the registers say."""
        return self.no_load_rpm * COUNTS_PER_TURN / 60


READ: Final = Access.READ
WRITE: Final = Access.WRITE
GAIN: Final = (0, 16_383)
FULL_LOAD: Final = 1000


def gain(address: int, name: str, default: int) -> Register:
    """A gain of its controllers; the simulation only stores it."""
    return Register(address, 2, name, WRITE, default, *GAIN)


def _indirect(banks: Sequence[Indirect]) -> list[Register]:
    """Each address points at its own data until it is set."""
    end = max(bank.data_at + bank.count for bank in banks) - 1
    registers: list[Register] = []
    for bank in banks:
        for k in range(bank.count):
            name, data_at = bank.first + k, bank.data_at + k
            address = Register(bank.address_at + 2 * k, 2, f"indirect_address_{name}", WRITE, data_at, RAM_BEGINS, end)
            registers += [address, Register(data_at, 1, f"indirect_data_{name}", WRITE, 0, 0, 255)]
    return registers


def x_series(number: int, firmware: int, own: Sequence[Register], indirect: Sequence[Indirect]) -> tuple[Register, ...]:
    """The registers that all models share, with a model's own inserted."""
    shared = [
        Register(0, 2, "model_number", READ, number),
        Register(2, 4, "model_information", READ),
        Register(6, 1, "firmware_version", READ, firmware),
        Register(7, 1, "id", WRITE, 1, 0, 252),
        Register(9, 1, "return_delay_time", WRITE, 250, 0, 254),
        Register(10, 1, "drive_mode", WRITE, 0, 0, 13),
        Register(11, 1, "operating_mode", WRITE, 3, 0, 16),
        Register(12, 1, "shadow_id", WRITE, 255, 0, 255),
        Register(13, 1, "protocol_type", WRITE, 2, 1, 2),
        Register(20, 4, "homing_offset", WRITE, 0, -1_044_479, 1_044_479, signed=True),
        Register(24, 4, "moving_threshold", WRITE, 10, 0, 1023),
        Register(36, 2, "pwm_limit", WRITE, 885, 0, 885),
        Register(48, 4, "max_position_limit", WRITE, 4095, 0, 4095),
        Register(52, 4, "min_position_limit", WRITE, 0, 0, 4095),
        Register(60, 1, "startup_configuration", WRITE, 0, 0, 3),
        Register(64, 1, "torque_enable", WRITE, 0, 0, 1),
        Register(68, 1, "status_return_level", WRITE, 2, 0, 2),
        Register(69, 1, "registered_instruction", READ),
        Register(70, 1, "hardware_error_status", READ),
        gain(88, "feedforward_2nd_gain", 0),
        gain(90, "feedforward_1st_gain", 0),
        # 255 is not in the range: it is what the register shows after the time has run out
        Register(98, 1, "bus_watchdog", WRITE, 0, 0, 127),
        Register(100, 2, "goal_pwm", WRITE, 885, signed=True),
        Register(104, 4, "goal_velocity", WRITE, 0, signed=True),
        Register(108, 4, "profile_acceleration", WRITE, 0, 0, 32_767),
        Register(112, 4, "profile_velocity", WRITE, 0, 0, 32_767),
        Register(116, 4, "goal_position", WRITE, CENTRE, signed=True),
        Register(120, 2, "realtime_tick", READ),
        Register(122, 1, "moving", READ),
        Register(123, 1, "moving_status", READ),
        Register(124, 2, "present_pwm", READ, signed=True),
        Register(128, 4, "present_velocity", READ, signed=True),
        Register(132, 4, "present_position", READ, CENTRE, signed=True),
        Register(136, 4, "velocity_trajectory", READ, signed=True),
        Register(140, 4, "position_trajectory", READ, CENTRE, signed=True),
        Register(144, 2, "present_input_voltage", READ),
        Register(146, 1, "present_temperature", READ),
        Register(147, 1, "backup_ready", READ),
    ]
    return tuple(sorted([*shared, *own, *_indirect(indirect)], key=lambda register: register.address))
