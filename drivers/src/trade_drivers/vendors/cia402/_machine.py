"""The state machine of a drive, as CiA 402-2 draws it: statuswords in, controlwords out. Pure."""

from enum import Enum
from typing import Final

__all__ = ["State", "command_towards_enabled", "state_of"]


class State(Enum):
    """Where a drive is, by the mask and value of its statusword."""

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
        """Whether the motor is powered: it holds, moves or brakes."""
        return self in {State.ENABLED, State.QUICK_STOP, State.FAULT_REACTION}


REMOTE: Final = 1 << 9
"""Statusword: it obeys the bus."""
ACKNOWLEDGED: Final = 1 << 12
"""Statusword in profile position: the set-point was taken; in homing: home was found."""
HOMING_ERROR: Final = 1 << 13
HOMING_STATUS: Final = 0x3400
HOMING_DONE: Final = 0x1400

DISABLE_VOLTAGE: Final = 0x0000
SHUTDOWN: Final = 0x0006
SWITCH_ON: Final = 0x0007
OPERATE: Final = 0x000F
NEW_SET_POINT: Final = 0x0010
"""Controlword in profile position: its rising edge starts the move; in homing: go."""
AT_ONCE: Final = 0x0020
"""Not after the move under way, but instead of it."""
RESET_FAULT: Final = 0x0080
HALT: Final = 0x0100
"""Brake, and stand under torque."""
HOLD: Final = OPERATE | HALT
QUICK_STOP: Final = 0x0002
"""Brake on the quick-stop ramp, in whatever mode: the cyclic ones know no halt."""
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
    """The state of a statusword; None for a pattern the standard does not know."""
    for state, mask, value in _PATTERNS:
        if statusword & mask == value:
            return state
    return None


def command_towards_enabled(state: State | None) -> int | None:
    """The controlword that takes a drive one step nearer to being enabled, halted; None where it has to be waited for.

    A fault is not among them: it is reset on purpose only.
    """
    return None if state is None else _UPWARDS.get(state)
