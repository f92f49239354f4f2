"""Numbers of Damiao motors (manuals of the DM-J series): identifiers, registers, modes, status, ranges."""

from enum import IntEnum
from typing import Final, NamedTuple

BROADCAST: Final = 0x7FF
POSITION_VELOCITY, VELOCITY, FORCE_POSITION = 0x100, 0x200, 0x300
MASTER: Final = 0x10
"""Added to a motor's identifier it gives that of its answers, as the vendor's tool sets it."""
ENABLE, DISABLE, ZERO, CLEAR = 0xFC, 0xFD, 0xFE, 0xFB
"""Last byte of a frame whose others are FF."""
READ, WRITE, STORE, REFRESH = 0x33, 0x55, 0xAA, 0xCC
ORDERS: Final = {
    ENABLE: "enable",
    DISABLE: "disable",
    ZERO: "set_zero",
    CLEAR: "clear_error",
}
QUESTIONS: Final = {
    READ: "read_register",
    WRITE: "write_register",
    STORE: "store",
    REFRESH: "refresh",
}
TARGETS: Final = {
    POSITION_VELOCITY: "pos_vel",
    VELOCITY: "vel",
    FORCE_POSITION: "force_pos",
}
TICKS_PER_S: Final = 20_000


class Register(IntEnum):
    """Registers whose contents this simulator uses."""

    ACCELERATION = 4
    DECELERATION = 5
    MAX_SPEED = 6
    MASTER_ID = 7
    ESC_ID = 8
    TIMEOUT = 9
    CONTROL_MODE = 10
    SOFTWARE = 14
    POSITION_MAX = 21
    VELOCITY_MAX = 22
    TORQUE_MAX = 23


WHOLE: Final = frozenset((*range(7, 11), *range(13, 17), 35, 36))
"""Registers that hold whole numbers; the others hold floats."""
KNOWN: Final = frozenset((*range(37), *range(50, 57), *range(59, 66), 80, 81))
READ_ONLY: Final = frozenset((*range(11, 21), 36, *range(50, 57), *range(59, 66), 80, 81))


class Mode(IntEnum):
    """Control modes; the commands of each have their own identifier."""

    MIT = 1
    POSITION_VELOCITY = 2
    VELOCITY = 3
    FORCE_POSITION = 4


class Status(IntEnum):
    """Status of a motor; from 8 on it has switched off its torque."""

    DISABLED = 0
    ENABLED = 1
    OVER_VOLTAGE = 8
    UNDER_VOLTAGE = 9
    OVER_CURRENT = 0xA
    DRIVER_TOO_HOT = 0xB
    ROTOR_TOO_HOT = 0xC
    LOST_COMMUNICATION = 0xD
    OVERLOAD = 0xE


class Ranges(NamedTuple):
    """Ranges of its numbers."""

    position_rad: float
    velocity_rad_s: float
    torque_nm: float


MODELS: Final = {
    "DM3507": Ranges(12.566, 50.0, 5.0),
    "DM4310": Ranges(12.5, 30.0, 10.0),
    "DM4310P": Ranges(12.5, 50.0, 10.0),
    "DM4340": Ranges(12.5, 10.0, 28.0),
    "DM4340P": Ranges(12.5, 10.0, 28.0),
    "DM6006": Ranges(12.5, 45.0, 20.0),
    "DM8006": Ranges(12.5, 45.0, 40.0),
    "DM8009": Ranges(12.5, 45.0, 54.0),
    "DM10010L": Ranges(12.5, 25.0, 200.0),
    "DM10010": Ranges(12.5, 20.0, 200.0),
    "DMH3510": Ranges(12.5, 280.0, 1.0),
    "DMG6215": Ranges(12.5, 45.0, 10.0),
    "DMH6220": Ranges(12.5, 45.0, 10.0),
    "DMJH11": Ranges(12.5, 10.0, 12.0),
    "DM6248P": Ranges(12.566, 20.0, 120.0),
}
"""Factory defaults."""
