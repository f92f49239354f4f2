"""The registers of a 2F-85, and what its numbers mean.

Source: Robotiq "2F-85 & 2F-140 Instruction Manual", chapter 4. Widths, speeds and forces: product sheet.
"""

from typing import Final

COMMAND: Final = 0x03E8
"""Action request, position request, speed and force: three registers, high byte first."""
STATUS: Final = 0x07D0
"""Gripper status, fault and position echo, position and current: three registers."""
REGISTERS: Final = 8
"""Sixteen bytes are reserved for each; those behind the first three registers read 0."""

ACTIVATE: Final = 0x01
GO: Final = 0x08
AUTO_RELEASE: Final = 0x10

DELAYED_FAULT: Final = 0x05
NOT_ACTIVATED_FAULT: Final = 0x07
COMMUNICATION_FAULT: Final = 0x09
HOT_FAULT: Final = 0x08
LOW_VOLTAGE_FAULT: Final = 0x0A
MAJOR_FAULT: Final = 0x0A
"""Faults from this one on stop the fingers until rACT has been 0."""

STROKE_M: Final = 0.085
OPEN_COUNTS: Final = 3
CLOSED_COUNTS: Final = 230
"""Positions of the mechanical stops; requests beyond end there."""
_SPEED_M_S: Final = (0.020, 0.150)
_FORCE_N: Final = (20.0, 235.0)
_SPAN: Final = CLOSED_COUNTS - OPEN_COUNTS


def width_of(counts: float) -> float:
    """Metres between the fingers at a position."""
    return (CLOSED_COUNTS - counts) * STROKE_M / _SPAN


def counts_of(width_m: float) -> float:
    """The position at a width; not rounded."""
    return CLOSED_COUNTS - width_m * _SPAN / STROKE_M


def speed_of(request: int) -> float:
    """Speed in counts/s of a speed request."""
    slow, fast = _SPEED_M_S
    return (slow + (fast - slow) * request / 255) * _SPAN / STROKE_M


def force_of(request: int) -> float:
    """Force in newtons of a force request."""
    weak, strong = _FORCE_N
    return weak + (strong - weak) * request / 255
