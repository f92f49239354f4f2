"""What Damiao motors say and are told, frame by frame: pure, no I/O.

Source: the vendor's manuals of the DM-J series (control protocol, registers). Two identifiers belong to a motor: that
it listens to (ESC_ID, register 8) and that it answers with (MST_ID, register 7).
"""

import struct
from collections.abc import Iterable
from enum import IntEnum
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from trade_drivers.bus.can import Talk

__all__ = ["MODELS", "Feedback", "Ranges", "Register", "Status"]

EVERYBODY: Final = 0x7FF
"""The identifier of questions about registers; the motor is named in the data."""
POSITION_VELOCITY: Final = 0x100
"""Added to a motor's identifier: where to, and how fast at most."""
MASTER: Final = 0x10
"""A motor's own identifier and this make that of its answers: what its vendor's tool sets."""
ENABLE, DISABLE, CLEAR = (bytes(7 * (0xFF,) + (last,)) for last in (0xFC, 0xFD, 0xFB))
_MODES: Final = (0, POSITION_VELOCITY, 0x200, 0x300)
"""Added to a motor's identifier, by its mode of control."""
TICKS_PER_S: Final = 20_000
"""Of the time after which a motor that hears nothing lets go."""
_POSITION: Final = struct.Struct("<ff")
_READ, _WRITE, _REFRESH = 0x33, 0x55, 0xCC
_FEEDBACK: Final = 8
FULL: Final = 1000
"""Parts of the torque that a motor can tell."""


def orders(talk: "Talk", nodes: Iterable[int] = ()) -> set[int]:  # noqa: ARG001 - nobody else has such identifiers
    """Identifiers among what was heard that only who commands or asks motors sends."""
    return talk.frames.keys() & ({EVERYBODY} | {base + motor for base in _MODES for motor in range(1, MASTER)})


class Register(IntEnum):
    """Those that are read or written here."""

    TIMEOUT = 9
    CONTROL_MODE = 10
    SOFTWARE = 14
    POSITION_MAX = 21
    VELOCITY_MAX = 22
    TORQUE_MAX = 23

    @property
    def is_float(self) -> bool:
        """Else it is a whole number."""
        return self in {Register.POSITION_MAX, Register.VELOCITY_MAX, Register.TORQUE_MAX}


IN_POSITION_VELOCITY: Final = 2
"""Of the control mode."""


class Status(IntEnum):
    """The upper half of the first byte of a feedback frame."""

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
    """What the ends of a motor's numbers mean; it scales with its own, so they must agree."""

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
"""As the vendor's tool sets them."""


class Feedback(NamedTuple):
    """What a motor answers to every command."""

    status: int
    nibble: int
    """The lower half of its own identifier."""
    position_rad: float
    velocity_rad_s: float
    torque_nm: float
    temperature_c: int
    """Of its driver or its rotor, whichever is hotter."""

    @classmethod
    def decode(cls, data: bytes, ranges: Ranges) -> "Feedback":
        """Out of eight bytes; struct.error for another number."""
        if len(data) != _FEEDBACK:
            raise struct.error(f"{len(data)} bytes")
        position = data[1] << 8 | data[2]
        velocity = data[3] << 4 | data[4] >> 4
        torque = (data[4] & 0xF) << 8 | data[5]
        return cls(
            data[0] >> 4,
            data[0] & 0xF,
            _value(position, 16, ranges.position_rad),
            _value(velocity, 12, ranges.velocity_rad_s),
            _value(torque, 12, ranges.torque_nm),
            max(data[6], data[7]),
        )


def _value(number: int, bits: int, most: float) -> float:
    return number * 2 * most / ((1 << bits) - 1) - most


def position_velocity(position_rad: float, velocity_rad_s: float) -> bytes:
    """Where to go, and how fast at most."""
    return _POSITION.pack(position_rad, velocity_rad_s)


def read(motor: int, register: Register) -> bytes:
    return bytes((motor, 0, _READ, register, 0, 0, 0, 0))


def write(motor: int, register: Register, value: int) -> bytes:
    """A whole number into a register, until power goes off."""
    return bytes((motor, 0, _WRITE, register)) + struct.pack("<I", value)


def refresh(motor: int) -> bytes:
    """Ask for a feedback frame without telling it anything."""
    return bytes((motor, 0, _REFRESH, 0, 0, 0, 0, 0))


def answer(data: bytes, motor: int, register: Register) -> float | int | None:
    """What a frame says of a register; None if it is no answer of this motor about that."""
    if len(data) != _FEEDBACK or data[:2] != bytes((motor, 0)) or data[2] not in {_READ, _WRITE} or data[3] != register:
        return None
    value: tuple[float | int] = struct.unpack("<f" if register.is_float else "<I", data[4:])
    return value[0]
