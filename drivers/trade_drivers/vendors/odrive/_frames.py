"""Encoding and decoding of ODrive frames. Pure, no I/O.

Numbers are little-endian; positions are in turns of the motor, speeds in turns per second.
"""

import struct
from typing import Final, NamedTuple

from trade_drivers.vendors.odrive._table import Command, Control, Errors, Input, State

_TWO: Final = struct.Struct("<ff")
_WORDS: Final = struct.Struct("<II")
_HEARTBEAT: Final = struct.Struct("<IBBBx")
_POSITION: Final = struct.Struct("<fhh")


class Heartbeat(NamedTuple):
    """The frame that an axis sends by itself."""

    errors: Errors
    state: int
    result: int
    trajectory_done: bool

    @classmethod
    def decode(cls, data: bytes) -> "Heartbeat":
        """Decodes eight bytes; raises struct.error for another size."""
        errors, state, result, flags = _HEARTBEAT.unpack(data)
        return cls(Errors(errors), state, result, bool(flags & 1))


class Health(NamedTuple):
    """Active errors, and the reason of the last disarming."""

    errors: Errors
    disarmed_by: Errors

    @classmethod
    def decode(cls, data: bytes) -> "Health":
        """Decodes eight bytes; raises struct.error for another size."""
        return cls(*map(Errors, _WORDS.unpack(data)))


class Version(NamedTuple):
    """Versions of hardware and firmware."""

    line: int
    """Product line: 4 Pro, 5 S1, 6 Micro."""
    hardware: tuple[int, int]
    firmware: tuple[int, int, int]

    @classmethod
    def decode(cls, data: bytes) -> "Version":
        """Decodes eight bytes; raises struct.error for another size."""
        _, line, version, variant, *firmware, _ = struct.unpack("<8B", data)
        return cls(line, (version, variant), (firmware[0], firmware[1], firmware[2]))


def frame_id(node: int, command: Command) -> int:
    """Returns the identifier of a frame to or from a node."""
    return node << 5 | command


def two_floats(data: bytes) -> tuple[float, float]:
    """Estimates (turns, turns/s), currents (A set, A measured), temperatures (C inverter, C motor), supply (V, A)."""
    return _TWO.unpack(data)


def set_state(state: State) -> bytes:
    return struct.pack("<I", state)


def set_mode(control: Control, way: Input) -> bytes:
    return _WORDS.pack(control, way)


def set_position(turns: float) -> bytes:
    return _POSITION.pack(turns, 0, 0)


def set_velocity(turns_s: float) -> bytes:
    return _TWO.pack(turns_s, 0.0)


def set_torque(torque_nm: float) -> bytes:
    return struct.pack("<f", torque_nm)


def set_trajectory_speed(turns_s: float) -> bytes:
    return struct.pack("<f", turns_s)


def set_trajectory_accel(turns_s2: float) -> bytes:
    """Acceleration and deceleration alike."""
    return _TWO.pack(turns_s2, turns_s2)
