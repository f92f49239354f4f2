"""Encoding and decoding of Damiao frames. Pure, no I/O."""

import struct
from typing import Final, NamedTuple

from trade_drivers.vendors.damiao._table import Ranges, Register

ENABLE, DISABLE, CLEAR = (bytes(7 * (0xFF,) + (last,)) for last in (0xFC, 0xFD, 0xFB))
_POSITION: Final = struct.Struct("<ff")
_READ, _WRITE, _REFRESH = 0x33, 0x55, 0xCC
_FEEDBACK: Final = 8


class Feedback(NamedTuple):
    """Feedback, the answer of a motor to each command."""

    status: int
    nibble: int
    """The lower half of the motor's identifier."""
    position_rad: float
    velocity_rad_s: float
    torque_nm: float
    temperature_c: int
    """The higher temperature of driver and rotor."""

    @classmethod
    def decode(cls, data: bytes, ranges: Ranges) -> "Feedback":
        """Decodes eight bytes; raises struct.error for another size."""
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
    """Returns a frame with a position and a maximum speed."""
    return _POSITION.pack(position_rad, velocity_rad_s)


def read(motor: int, register: Register) -> bytes:
    return bytes((motor, 0, _READ, register, 0, 0, 0, 0))


def write(motor: int, register: Register, value: int) -> bytes:
    """Returns a frame that writes an integer to a register until power-off."""
    return bytes((motor, 0, _WRITE, register)) + struct.pack("<I", value)


def refresh(motor: int) -> bytes:
    """Returns a request for feedback without a command."""
    return bytes((motor, 0, _REFRESH, 0, 0, 0, 0, 0))


def answer(data: bytes, motor: int, register: Register) -> float | int | None:
    """Returns the register value in a frame; None if it is not this motor's answer about it."""
    if len(data) != _FEEDBACK or data[:2] != bytes((motor, 0)) or data[2] not in {_READ, _WRITE} or data[3] != register:
        return None
    value: tuple[float | int] = struct.unpack("<f" if register.is_float else "<I", data[4:])
    return value[0]
