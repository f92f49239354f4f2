"""Decoding of CAN error frames. Pure, no I/O.

Source: Linux ``include/uapi/linux/can/error.h``: the class is in the identifier, the controller's state in data[1].
"""

from enum import IntEnum
from typing import Final

from trade_drivers.bus._can_monitor import ErrorWord

_CONTROLLER: Final = 0x004
_NO_ACKNOWLEDGEMENT: Final = 0x020
_BUS_OFF: Final = 0x040
_RESTARTED: Final = 0x100
_WARNING: Final = 0x0C
_PASSIVE: Final = 0x30
_ACTIVE: Final = 0x40


class ErrorState(IntEnum):
    """The error state of this end's controller; a higher value is worse."""

    ACTIVE = 0
    """No problem."""
    WARNING = 1
    PASSIVE = 2
    """The controller may no longer signal errors to others."""
    BUS_OFF = 3
    """The controller has switched itself off the bus."""

    @property
    def word(self) -> ErrorWord:
        """The name in ISO 11898-1."""
        return _WORDS[self]


_WORDS: Final[dict[ErrorState, ErrorWord]] = {
    ErrorState.ACTIVE: "error-active",
    ErrorState.WARNING: "error-warning",
    ErrorState.PASSIVE: "error-passive",
    ErrorState.BUS_OFF: "bus-off",
}


def error_state(frame_id: int, data: bytes) -> ErrorState | None:
    """Returns the state that an error frame reports, or None."""
    if frame_id & _BUS_OFF:
        return ErrorState.BUS_OFF
    if frame_id & _RESTARTED:
        return ErrorState.ACTIVE
    if not frame_id & _CONTROLLER or len(data) < 2:
        return None
    for bits, state in ((_PASSIVE, ErrorState.PASSIVE), (_WARNING, ErrorState.WARNING), (_ACTIVE, ErrorState.ACTIVE)):
        if data[1] & bits:
            return state
    return None


def unheard(frame_id: int) -> bool:
    """Returns whether an error frame reports that nothing acknowledged a frame of this end."""
    return bool(frame_id & _NO_ACKNOWLEDGEMENT)
