"""What this driver uses of ODrives: commands, states, errors, and models. Data, no I/O.

Source: ODrive documentation, "CANSimple protocol", firmware 0.6.
"""

from collections.abc import Iterable
from enum import IntEnum, IntFlag
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from trade_drivers.bus.can import FramesById

NODES: Final = 63
"""The value for a missing node number; valid ones are lower."""


class Model(NamedTuple):
    """A kind of ODrive."""

    line: int
    """Product line, as the device reports it."""
    peak_a: float
    """Maximum motor current (data sheet)."""


MODELS: Final = {
    "ODrive Pro": Model(4, 120.0),
    "ODrive S1": Model(5, 80.0),
    "ODrive Micro": Model(6, 7.0),
}


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


def orders(sniffed: "FramesById", nodes: Iterable[int] = ()) -> set[int]:
    """Returns identifiers that only a driver sends, for these nodes or those that send heartbeats.

    Requests are included: they feed the watchdog of an axis, which then would miss the death of its driver.
    """
    known = {*nodes, *sniffed.odrives}
    return {
        can_id
        for can_id, frames in sniffed.frames.items()
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
