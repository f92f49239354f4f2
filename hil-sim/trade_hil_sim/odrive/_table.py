"""Numbers of CANSimple, firmware 0.6 (ODrive documentation): commands, states, modes, errors, layouts."""

import struct
from enum import IntEnum, IntFlag
from typing import Final


class Command(IntEnum):
    """The low five bits of an identifier; the node is above."""

    GET_VERSION = 0x00
    HEARTBEAT = 0x01
    ESTOP = 0x02
    GET_ERROR = 0x03
    ADDRESS = 0x06
    SET_AXIS_STATE = 0x07
    GET_ENCODER_ESTIMATES = 0x09
    SET_CONTROLLER_MODE = 0x0B
    SET_INPUT_POS = 0x0C
    SET_INPUT_VEL = 0x0D
    SET_INPUT_TORQUE = 0x0E
    SET_LIMITS = 0x0F
    SET_TRAJ_VEL_LIMIT = 0x11
    SET_TRAJ_ACCEL_LIMITS = 0x12
    SET_TRAJ_INERTIA = 0x13
    GET_IQ = 0x14
    GET_TEMPERATURE = 0x15
    REBOOT = 0x16
    GET_BUS_VOLTAGE_CURRENT = 0x17
    CLEAR_ERRORS = 0x18
    SET_ABSOLUTE_POSITION = 0x19
    GET_TORQUES = 0x1C
    GET_POWERS = 0x1D


class State(IntEnum):
    """The state of an axis."""

    IDLE = 1
    CLOSED_LOOP_CONTROL = 8


class Control(IntEnum):
    """Control modes."""

    TORQUE = 1
    VELOCITY = 2
    POSITION = 3


class Input(IntEnum):
    """Input modes."""

    PASSTHROUGH = 1
    VEL_RAMP = 2
    POS_FILTER = 3
    TRAP_TRAJ = 5


class Result(IntEnum):
    """The result of a change of state."""

    SUCCESS = 0
    DISARMED = 3
    INVALID_STATE = 13
    NOT_CALIBRATED = 14


class Errors(IntFlag):
    """Errors that a simulated axis detects itself; a fault can set others."""

    UNDER_VOLTAGE = 0x200
    OVER_VOLTAGE = 0x100
    INVERTER_TOO_HOT = 0x4000
    WATCHDOG = 0x1000000
    ESTOP = 0x2000000


ANSWERS: Final = frozenset(
    {
        Command.GET_VERSION,
        Command.HEARTBEAT,
        Command.GET_ERROR,
        Command.GET_ENCODER_ESTIMATES,
        Command.GET_IQ,
        Command.GET_TEMPERATURE,
        Command.GET_BUS_VOLTAGE_CURRENT,
        Command.GET_TORQUES,
        Command.GET_POWERS,
    }
)
"""Messages of an axis: cyclic, or requested by a remote frame or one without data."""

ORDERS: Final = {
    Command.ESTOP: struct.Struct(""),
    Command.SET_AXIS_STATE: struct.Struct("<I"),
    Command.SET_CONTROLLER_MODE: struct.Struct("<II"),
    Command.SET_INPUT_POS: struct.Struct("<fhh"),
    Command.SET_INPUT_VEL: struct.Struct("<ff"),
    Command.SET_INPUT_TORQUE: struct.Struct("<f"),
    Command.SET_LIMITS: struct.Struct("<ff"),
    Command.SET_TRAJ_VEL_LIMIT: struct.Struct("<f"),
    Command.SET_TRAJ_ACCEL_LIMITS: struct.Struct("<ff"),
    Command.SET_TRAJ_INERTIA: struct.Struct("<f"),
    Command.REBOOT: struct.Struct("<B"),
    Command.CLEAR_ERRORS: struct.Struct(""),
    Command.SET_ABSOLUTE_POSITION: struct.Struct("<f"),
}
"""Commands to an axis; longer data is cut, shorter data is ignored."""
