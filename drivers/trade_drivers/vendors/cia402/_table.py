"""Objects of a drive's dictionary that this driver uses, their frames, and the state machine. Data, no I/O.

Sources: CiA 301 (1000h to 1FFFh, identifiers) and CiA 402-2 (6000h on).
"""

import struct
from collections.abc import Iterable
from enum import Enum
from typing import TYPE_CHECKING, Final, Literal

from msgspec import Struct

if TYPE_CHECKING:
    from trade_drivers.bus.can import FramesById

Kind = Literal["u1", "u2", "u4", "i1", "i2", "i4"]


class DictionaryEntry(Struct, frozen=True):
    """One object, or one field of it."""

    index: int
    kind: Kind
    sub: int = 0

    @property
    def size(self) -> int:
        """Size in bytes."""
        return int(self.kind[1])

    def decode(self, data: bytes) -> int:
        """Decodes a number; drives may answer with extra bytes."""
        return int.from_bytes(data[: self.size], "little", signed=self.kind[0] == "i")

    def encode(self, value: int) -> bytes:
        """Returns the bytes of a number; raises OverflowError if they do not fit."""
        return value.to_bytes(self.size, "little", signed=self.kind[0] == "i")

    def __str__(self) -> str:
        return f"{self.index:04X}h" + (f":{self.sub}" if self.sub else "")


DEVICE_TYPE: Final = DictionaryEntry(0x1000, "u4")
DEVICE_NAME: Final = 0x1008
SOFTWARE_VERSION: Final = 0x100A
CONSUMER_HEARTBEAT: Final = DictionaryEntry(0x1016, "u4", 1)
"""The monitored heartbeat: ``node << 16`` plus the timeout in milliseconds."""
PRODUCER_HEARTBEAT: Final = DictionaryEntry(0x1017, "u2")
"""In milliseconds."""
IDENTITY: Final = tuple(DictionaryEntry(0x1018, "u4", sub) for sub in (1, 2, 3, 4))
"""Vendor, product, revision, serial number."""

ABORT_CONNECTION: Final = DictionaryEntry(0x6007, "i2")
ERROR_CODE: Final = DictionaryEntry(0x603F, "u2")
CONTROLWORD: Final = DictionaryEntry(0x6040, "u2")
STATUSWORD: Final = DictionaryEntry(0x6041, "u2")
QUICK_STOP_OPTION: Final = DictionaryEntry(0x605A, "i2")
HALT_OPTION: Final = DictionaryEntry(0x605D, "i2")
MODE: Final = DictionaryEntry(0x6060, "i1")
MODE_DISPLAY: Final = DictionaryEntry(0x6061, "i1")
POSITION: Final = DictionaryEntry(0x6064, "i4")
VELOCITY: Final = DictionaryEntry(0x606C, "i4")
TORQUE: Final = DictionaryEntry(0x6077, "i2")
TARGET_POSITION: Final = DictionaryEntry(0x607A, "i4")
ENCODER: Final = (DictionaryEntry(0x608F, "u4", 1), DictionaryEntry(0x608F, "u4", 2))
"""Increments of the encoder, for so many turns of the motor."""
GEAR_RATIO: Final = (DictionaryEntry(0x6091, "u4", 1), DictionaryEntry(0x6091, "u4", 2))
"""Turns of the motor, for so many of the shaft."""
FEED: Final = (DictionaryEntry(0x6092, "u4", 1), DictionaryEntry(0x6092, "u4", 2))
"""Counts of a position, for so many turns of the shaft."""
POSITION_UNIT, VELOCITY_UNIT, ACCELERATION_UNIT = (DictionaryEntry(index, "u4") for index in (0x60A8, 0x60A9, 0x60AA))
POSITION_LIMITS: Final = (DictionaryEntry(0x607D, "i4", 1), DictionaryEntry(0x607D, "i4", 2))
POLARITY: Final = DictionaryEntry(0x607E, "u1")
"""Bits that reverse positions and speeds."""
REVERSED: Final = 0xC0
MAX_PROFILE_VELOCITY: Final = DictionaryEntry(0x607F, "u4")
PROFILE_VELOCITY: Final = DictionaryEntry(0x6081, "u4")
ACCELERATION: Final = DictionaryEntry(0x6083, "u4")
DECELERATION: Final = DictionaryEntry(0x6084, "u4")
QUICK_STOP_DECELERATION: Final = DictionaryEntry(0x6085, "u4")
HOMING_METHOD: Final = DictionaryEntry(0x6098, "i1")
HOMING_SPEEDS: Final = (DictionaryEntry(0x6099, "u4", 1), DictionaryEntry(0x6099, "u4", 2))
HOMING_ACCELERATION: Final = DictionaryEntry(0x609A, "u4")
INTERPOLATION_PERIOD: Final = (DictionaryEntry(0x60C2, "u1", 1), DictionaryEntry(0x60C2, "i1", 2))
"""The interpolation period of a cyclic position: a number and a power of ten in s."""
TARGET_VELOCITY: Final = DictionaryEntry(0x60FF, "i4")
SUPPORTED_MODES: Final = DictionaryEntry(0x6502, "u4")
"""Bit ``mode - 1`` for each."""

PROFILE_POSITION: Final = 1
PROFILE_VELOCITY_MODE: Final = 3
HOMING: Final = 6
CYCLIC_POSITION: Final = 8
CYCLIC_VELOCITY: Final = 9
STANDING: Final = (5, 6, 7)
"""Values of 605Ah that hold with torque after a quick stop."""
DRIVE_PROFILE: Final = 402
FULL_TORQUE: Final = 1000
"""Counts of the rated torque."""

OUR_NODE: Final = 127
"""The node whose heartbeats the drives monitor: this driver."""
NMT: Final = 0x000
SYNC: Final = 0x080
EMERGENCY: Final = 0x080
SDO_ANSWER, SDO_REQUEST = 0x580, 0x600
HEARTBEAT: Final = 0x700
NMT_START, NMT_PREOPERATIONAL = 0x01, 0x80
BOOT_UP, STOPPED, OPERATIONAL, PREOPERATIONAL = 0x00, 0x04, 0x05, 0x7F
NMT_STATES: Final = {BOOT_UP: "booting", STOPPED: "stopped", OPERATIONAL: "operational", PREOPERATIONAL: "pre-op"}

NO_SUCH_OBJECT: Final = (0x06020000, 0x06090011)
NOT_IN_THIS_STATE: Final = 0x08000022


def orders(sniffed: "FramesById", nodes: Iterable[int] = ()) -> set[int]:
    """Returns identifiers that only a driver sends, for these nodes or those that send heartbeats."""
    network_wide = {NMT, SYNC, HEARTBEAT + OUR_NODE}
    bases = (SDO_REQUEST, *(pdo.base for pdo in (COMMAND, PROFILE, BRAKING, FOLLOWING)))
    return sniffed.frames.keys() & (
        network_wide | {base + node for base in bases for node in {*nodes, *sniffed.canopen}}
    )


class Pdo(Struct, frozen=True):
    """The fields of one process data object, little-endian and without gaps."""

    communication: int
    """The index of its communication parameters; the index of its mapping is 200h higher."""
    base: int
    """The identifier without the node number."""
    entries: tuple[DictionaryEntry, ...]
    layout: struct.Struct

    def mapping(self) -> list[int]:
        """Returns the words of the mapping record."""
        return [entry.index << 16 | entry.sub << 8 | entry.size * 8 for entry in self.entries]


STATUS: Final = Pdo(0x1800, 0x180, (STATUSWORD, POSITION, TORQUE), struct.Struct("<Hih"))
MOTION: Final = Pdo(0x1801, 0x280, (VELOCITY, MODE_DISPLAY, ERROR_CODE), struct.Struct("<ibH"))
COMMAND: Final = Pdo(0x1400, 0x200, (CONTROLWORD, TARGET_POSITION), struct.Struct("<Hi"))
PROFILE: Final = Pdo(0x1401, 0x300, (PROFILE_VELOCITY, ACCELERATION), struct.Struct("<II"))
BRAKING: Final = Pdo(0x1402, 0x400, (DECELERATION,), struct.Struct("<I"))
TURNING: Final = Pdo(0x1402, 0x400, (DECELERATION, TARGET_VELOCITY), struct.Struct("<Ii"))
"""Replaces ``BRAKING`` on drives with a velocity mode."""
FOLLOWING: Final = Pdo(0x1403, 0x500, (TARGET_POSITION,), struct.Struct("<i"))
UNUSED: Final = (0x1802, 0x1803)
AT_NEXT_SYNC: Final = 1
AT_EVENT: Final = 255
INVALID: Final = 1 << 31
NO_REMOTE: Final = 1 << 30


class State(Enum):
    """States of a drive, with mask and value of the statusword."""

    NOT_READY = (0x4F, 0x00)
    SWITCH_ON_DISABLED = (0x4F, 0x40)
    READY = (0x6F, 0x21)
    SWITCHED_ON = (0x6F, 0x23)
    ENABLED = (0x6F, 0x27)
    QUICK_STOP = (0x6F, 0x07)
    FAULT_REACTION = (0x4F, 0x0F)
    FAULT = (0x4F, 0x08)

    @property
    def torque(self) -> bool:
        """Whether torque is on: the motor holds, moves or brakes."""
        return self in {State.ENABLED, State.QUICK_STOP, State.FAULT_REACTION}


REMOTE: Final = 1 << 9
"""Statusword: the drive follows the bus."""
ACKNOWLEDGED: Final = 1 << 12
"""Statusword in profile position: set-point acknowledged; in homing: home found."""
HOMING_ERROR: Final = 1 << 13
HOMING_STATUS: Final = 0x3400
HOMING_DONE: Final = 0x1400

DISABLE_VOLTAGE: Final = 0x0000
SHUTDOWN: Final = 0x0006
SWITCH_ON: Final = 0x0007
OPERATE: Final = 0x000F
NEW_SET_POINT: Final = 0x0010
"""Controlword in profile position: its rising edge starts the move; in homing: start."""
AT_ONCE: Final = 0x0020
"""Replaces the current move instead of following it."""
RESET_FAULT: Final = 0x0080
HALT: Final = 0x0100
"""Brake, and hold with torque."""
HOLD: Final = OPERATE | HALT
QUICK_STOP: Final = 0x0002
"""Brake on the quick-stop ramp, in all modes, as the cyclic ones have no halt."""
GO: Final = OPERATE | NEW_SET_POINT | AT_ONCE

_PATTERNS: Final = tuple((state, *state.value) for state in State)
_UPWARDS: Final = {
    State.SWITCH_ON_DISABLED: SHUTDOWN,
    State.READY: SWITCH_ON,
    State.SWITCHED_ON: HOLD,
    State.QUICK_STOP: HOLD,
    State.ENABLED: HOLD,
}


def state_of(statusword: int) -> State | None:
    """Returns the state of a statusword; None for a pattern outside the standard."""
    for state, mask, value in _PATTERNS:
        if statusword & mask == value:
            return state
    return None


def command_towards_enabled(state: State | None) -> int | None:
    """Returns the controlword for one step towards enabled and halted; None in states to wait in.

    It never resets a fault, which needs an explicit call.
    """
    return None if state is None else _UPWARDS.get(state)
