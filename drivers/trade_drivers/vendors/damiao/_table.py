"""What this driver uses of Damiao motors: identifiers, registers, states, and models with their ranges. Data, no I/O.

Source: the vendor's manuals of the DM-J series (control protocol, registers). Two identifiers belong to a motor: that
it listens to (ESC_ID, register 8) and that it answers with (MST_ID, register 7).
"""

from collections.abc import Iterable
from enum import IntEnum
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from trade_drivers.bus.can import FramesById

BROADCAST: Final = 0x7FF
"""The identifier of register requests; the data contains the motor."""
POSITION_VELOCITY: Final = 0x100
"""Added to a motor's identifier for frames with a position and a maximum speed."""
MASTER: Final = 0x10
"""Added to a motor's identifier for its answers, as the vendor's tool sets it."""
_MODES: Final = (0, POSITION_VELOCITY, 0x200, 0x300)
"""Added to a motor's identifier, by control mode."""
TICKS_PER_S: Final = 20_000
"""Unit of the watchdog timeout, after which a motor switches its torque off."""
FULL: Final = 1000
"""Steps of the torque in feedback."""


def orders(sniffed: "FramesById", nodes: Iterable[int] = ()) -> set[int]:  # noqa: ARG001 - identifiers are unique to such drivers
    """Returns the identifiers among the traffic that only a driver of such motors sends."""
    return sniffed.frames.keys() & ({BROADCAST} | {base + motor for base in _MODES for motor in range(1, MASTER)})


class Register(IntEnum):
    """The registers that this driver uses."""

    TIMEOUT = 9
    CONTROL_MODE = 10
    SOFTWARE = 14
    POSITION_MAX = 21
    VELOCITY_MAX = 22
    TORQUE_MAX = 23

    @property
    def is_float(self) -> bool:
        """Whether the register is a float; otherwise it is an integer."""
        return self in {Register.POSITION_MAX, Register.VELOCITY_MAX, Register.TORQUE_MAX}


IN_POSITION_VELOCITY: Final = 2
"""Value of the control mode register."""


class Status(IntEnum):
    """State or error: the upper half of the first byte of a feedback frame."""

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
    """The ranges by which a motor scales its values; the driver's must be the same."""

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
"""Models with the ranges that the vendor's tool sets."""
