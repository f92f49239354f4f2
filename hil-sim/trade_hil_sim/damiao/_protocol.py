"""MIT commands and feedback as bit fields. Pure."""

from typing import Final, NamedTuple

from ._table import Ranges

STIFFEST: Final = 500.0
MOST_DAMPING: Final = 5.0


class Impedance(NamedTuple):
    """A MIT command: a spring, a damper and a torque."""

    position_rad: float
    velocity_rad_s: float
    stiffness: float
    damping: float
    torque_nm: float


def decode_mit(data: bytes, ranges: Ranges) -> Impedance:
    """Unpack 16, 12, 12, 12 and 12 bits, the most significant first."""
    whole = int.from_bytes(data, "big")
    return Impedance(
        _value(whole >> 48, 16, -ranges.position_rad, ranges.position_rad),
        _value(whole >> 36 & 0xFFF, 12, -ranges.velocity_rad_s, ranges.velocity_rad_s),
        _value(whole >> 24 & 0xFFF, 12, 0.0, STIFFEST),
        _value(whole >> 12 & 0xFFF, 12, 0.0, MOST_DAMPING),
        _value(whole & 0xFFF, 12, -ranges.torque_nm, ranges.torque_nm),
    )


def encode_feedback(
    status: int, esc_id: int, place: tuple[float, float, float], ranges: Ranges, temperatures_c: tuple[int, int]
) -> bytes:
    """Pack position, velocity and torque in 16, 12 and 12 bits, after the id and before the temperatures."""
    position, velocity, torque = (
        _number(value, bits, most) for value, bits, most in zip(place, (16, 12, 12), ranges, strict=True)
    )
    body = (position << 24 | velocity << 12 | torque).to_bytes(5, "big")
    return bytes((status << 4 | esc_id & 0xF,)) + body + bytes(temperatures_c)


def _value(number: int, bits: int, low: float, high: float) -> float:
    return number * (high - low) / ((1 << bits) - 1) + low


def _number(value: float, bits: int, most: float) -> int:
    return int((max(-most, min(most, value)) + most) * ((1 << bits) - 1) / (2 * most))
