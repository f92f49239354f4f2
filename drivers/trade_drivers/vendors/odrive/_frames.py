"""Encoding and decoding of ODrive frames. Pure, no I/O.

Source: ODrive documentation, "CANSimple protocol", firmware 0.6. Numbers are little-endian; positions are in turns of
the motor, speeds in turns per second.
"""

import struct
from collections.abc import Iterable
from enum import IntEnum, IntFlag
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from trade_drivers.bus.can import Talk

NODES: Final = 63
"""The value for a missing node number; valid ones are lower."""
_TWO: Final = struct.Struct("<ff")
_WORDS: Final = struct.Struct("<II")
_HEARTBEAT: Final = struct.Struct("<IBBBx")
_POSITION: Final = struct.Struct("<fhh")


class Command(IntEnum):
    """The low five bits of an identifier. Requests have no data."""

    VERSION = 0x00
    HEARTBEAT = 0x01
    ESTOP = 0x02
    ERRORS = 0x03
    ADDRESS = 0x06
    SET_STATE = 0x07
    ESTIMATES = 0x09
    SET_MODE = 0x0B
    SET_POSITION = 0x0C
    SET_VELOCITY = 0x0D
    SET_TORQUE = 0x0E
    SET_TRAJECTORY_SPEED = 0x11
    SET_TRAJECTORY_ACCEL = 0x12
    CURRENTS = 0x14
    TEMPERATURES = 0x15
    SUPPLY = 0x17
    CLEAR_ERRORS = 0x18


ORDERS: Final = frozenset(
    {
        Command.ESTOP,
        Command.SET_STATE,
        Command.SET_MODE,
        Command.SET_POSITION,
        Command.SET_VELOCITY,
        Command.SET_TORQUE,
        Command.SET_TRAJECTORY_SPEED,
        Command.SET_TRAJECTORY_ACCEL,
        Command.CLEAR_ERRORS,
    }
)


def orders(talk: "Talk", nodes: Iterable[int] = ()) -> set[int]:
    """Returns identifiers that only a driver sends, for these nodes or those that send heartbeats.

    Requests are included: they feed the watchdog of an axis, which then would miss the death of its driver.
    """
    known = {*nodes, *talk.odrives}
    return {
        can_id
        for can_id, frames in talk.frames.items()
        if can_id >> 5 in known and (can_id & 0x1F in ORDERS or not all(frames))
    }


class State(IntEnum):
    """Axis states, as far as this driver requests them."""

    IDLE = 1
    CLOSED_LOOP = 8


class Control(IntEnum):
    """Control modes."""

    TORQUE = 1
    VELOCITY = 2

    POSITION = 3


class Input(IntEnum):
    """Input modes of the controller."""

    PASSTHROUGH = 1
    VELOCITY_RAMP = 2
    TRAJECTORY = 5


class Errors(IntFlag):
    """Errors of an axis, which disarm it or prevent arming."""

    INITIALIZING = 0x1
    SYSTEM = 0x2
    TIMING = 0x4
    MISSING_ESTIMATE = 0x8
    BAD_CONFIG = 0x10
    GATE_DRIVER = 0x20
    MISSING_INPUT = 0x40
    OVER_VOLTAGE = 0x100
    UNDER_VOLTAGE = 0x200
    SUPPLY_OVER_CURRENT = 0x400
    SUPPLY_OVER_REGENERATION = 0x800
    CURRENT_LIMIT = 0x1000
    MOTOR_TOO_HOT = 0x2000
    INVERTER_TOO_HOT = 0x4000
    VELOCITY_LIMIT = 0x8000
    POSITION_LIMIT = 0x10000
    WATCHDOG = 0x1000000
    ESTOP = 0x2000000
    SPINOUT = 0x4000000
    BRAKE_RESISTOR = 0x8000000
    THERMISTOR = 0x10000000
    CALIBRATION = 0x40000000

    @property
    def text(self) -> str:
        """The names of the bits; unknown bits as numbers."""
        known = [flag for flag in Errors if flag & self]
        rest = int(self) & ~sum(known)
        names = [flag.name.lower().replace("_", " ") for flag in known if flag.name]
        return ", ".join([*names, *([f"{rest:X}h"] if rest else [])])


class Result(IntEnum):
    """Results of a requested state change."""

    SUCCESS = 0
    BUSY = 1
    CANCELLED = 2
    DISARMED = 3
    NO_RESPONSE = 4
    TIMEOUT = 11
    INVALID_STATE = 13
    NOT_CALIBRATED = 14


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
