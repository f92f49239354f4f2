"""The state machine of a drive (CiA 402-2, 6.4): which command leads from which state to which. Pure."""

from enum import Enum, IntEnum
from typing import Final

__all__ = ["Command", "State", "command", "next_state"]


class State(IntEnum):
    """States, as the bits of the statusword that tell them apart."""

    SWITCH_ON_DISABLED = 0x40
    READY_TO_SWITCH_ON = 0x21
    SWITCHED_ON = 0x23
    OPERATION_ENABLED = 0x27
    QUICK_STOP_ACTIVE = 0x07
    FAULT_REACTION_ACTIVE = 0x0F
    FAULT = 0x08


class Command(Enum):
    """What the lower bits of a controlword say."""

    DISABLE_VOLTAGE = "disable_voltage"
    QUICK_STOP = "quick_stop"
    SHUTDOWN = "shutdown"
    SWITCH_ON = "switch_on"
    ENABLE_OPERATION = "enable_operation"


def command(controlword: int) -> Command:
    """The command in a controlword."""
    match controlword & 0b1111:
        case bits if not bits & 2:
            return Command.DISABLE_VOLTAGE
        case bits if not bits & 4:
            return Command.QUICK_STOP
        case bits if not bits & 1:
            return Command.SHUTDOWN
        case bits if not bits & 8:
            return Command.SWITCH_ON
        case _:
            return Command.ENABLE_OPERATION


_OFF: Final = State.SWITCH_ON_DISABLED
_TRANSITIONS: Final = {
    State.SWITCH_ON_DISABLED: {Command.SHUTDOWN: State.READY_TO_SWITCH_ON},
    State.READY_TO_SWITCH_ON: {
        Command.SWITCH_ON: State.SWITCHED_ON,
        Command.ENABLE_OPERATION: State.OPERATION_ENABLED,  # 3 and 4 at once
        Command.QUICK_STOP: _OFF,
        Command.DISABLE_VOLTAGE: _OFF,
    },
    State.SWITCHED_ON: {
        Command.SHUTDOWN: State.READY_TO_SWITCH_ON,
        Command.ENABLE_OPERATION: State.OPERATION_ENABLED,
        Command.QUICK_STOP: _OFF,
        Command.DISABLE_VOLTAGE: _OFF,
    },
    State.OPERATION_ENABLED: {
        Command.SWITCH_ON: State.SWITCHED_ON,
        Command.SHUTDOWN: State.READY_TO_SWITCH_ON,
        Command.QUICK_STOP: State.QUICK_STOP_ACTIVE,
        Command.DISABLE_VOLTAGE: _OFF,
    },
    State.QUICK_STOP_ACTIVE: {
        Command.ENABLE_OPERATION: State.OPERATION_ENABLED,
        Command.DISABLE_VOLTAGE: _OFF,
    },
}


def next_state(state: State, wanted: Command) -> State:
    """Where a command leads; a state that does not know it stays."""
    return _TRANSITIONS.get(state, {}).get(wanted, state)
