"""The state machine of CiA 402-2: from statuswords to controlwords. Pure."""

from enum import Enum
from typing import Final


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
