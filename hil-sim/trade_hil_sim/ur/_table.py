"""The fields of a controller's RTDE interface, and the numbers of its modes.

Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide": field names and types, robot and safety modes.
"""

from enum import IntEnum
from typing import Final, NamedTuple

TYPES: Final = {
    "BOOL": "?",
    "UINT8": "B",
    "UINT32": "I",
    "UINT64": "Q",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
    "VECTOR6UINT32": "6I",
}
"""Type of a field -> its format, big-endian."""

_SIXES: Final = (
    *("target_q", "target_qd", "target_qdd", "target_current", "target_moment"),
    *("actual_q", "actual_qd", "actual_current", "joint_control_output"),
    *("actual_TCP_pose", "actual_TCP_speed", "actual_TCP_force", "target_TCP_pose", "target_TCP_speed"),
    *("joint_temperatures", "actual_joint_voltage", "ft_raw_wrench", "payload_inertia"),
)
_DOUBLES: Final = (
    *("timestamp", "actual_execution_time", "speed_scaling", "target_speed_fraction", "actual_momentum"),
    *("actual_main_voltage", "actual_robot_voltage", "actual_robot_current", "payload"),
    *("standard_analog_input0", "standard_analog_input1", "standard_analog_output0", "standard_analog_output1"),
)
OUTPUTS: Final = {
    **dict.fromkeys(_SIXES, "VECTOR6D"),
    **dict.fromkeys(_DOUBLES, "DOUBLE"),
    **dict.fromkeys(("actual_tool_accelerometer", "payload_cog"), "VECTOR3D"),
    **dict.fromkeys(("actual_digital_input_bits", "actual_digital_output_bits"), "UINT64"),
    **dict.fromkeys(("robot_mode", "safety_mode"), "INT32"),
    **dict.fromkeys(("runtime_state", "robot_status_bits", "safety_status_bits"), "UINT32"),
    "joint_mode": "VECTOR6INT32",
    **{f"output_int_register_{n}": "INT32" for n in range(48)},
    **{f"output_double_register_{n}": "DOUBLE" for n in range(48)},
}
"""Name -> type of the fields that a client can read."""

_BYTES: Final = (
    *("standard_digital_output", "standard_digital_output_mask"),
    *("configurable_digital_output", "configurable_digital_output_mask"),
    *("tool_digital_output", "tool_digital_output_mask", "standard_analog_output_mask", "standard_analog_output_type"),
)
INPUTS: Final = {
    "speed_slider_mask": "UINT32",
    "speed_slider_fraction": "DOUBLE",
    **dict.fromkeys(_BYTES, "UINT8"),
    **dict.fromkeys(("standard_analog_output_0", "standard_analog_output_1"), "DOUBLE"),
    "external_force_torque": "VECTOR6D",
    **{f"input_int_register_{n}": "INT32" for n in range(48)},
    **{f"input_double_register_{n}": "DOUBLE" for n in range(48)},
}
"""Name -> type of the fields that a client can set."""


class RobotMode(IntEnum):
    """``robot_mode``."""

    BOOTING = 2
    POWER_OFF = 3
    POWER_ON = 4
    IDLE = 5
    BACKDRIVE = 6
    RUNNING = 7


class SafetyMode(IntEnum):
    """``safety_mode``."""

    NORMAL = 1
    REDUCED = 2
    PROTECTIVE_STOP = 3
    RECOVERY = 4
    SAFEGUARD_STOP = 5
    SYSTEM_EMERGENCY_STOP = 6
    ROBOT_EMERGENCY_STOP = 7
    VIOLATION = 8
    FAULT = 9

    @property
    def status_bits(self) -> int:
        """``safety_status_bits`` of that mode: one bit each, in this order."""
        return 1 << (self - 1)

    @property
    def moves(self) -> bool:
        """Whether the arm may move in it."""
        return self in {SafetyMode.NORMAL, SafetyMode.REDUCED}

    @property
    def cuts_power(self) -> bool:
        """Whether this mode cuts the arm's power, which then stays off."""
        return self > SafetyMode.SAFEGUARD_STOP


class Command(IntEnum):
    """Commands in ``input_int_register_0`` to the control script of ur-rtde 1.6.5 (observed on the wire)."""

    NOTHING = 0
    MOVE_J = 1
    MOVE_J_IK = 2
    MOVE_L = 3
    MOVE_L_FK = 4
    SPEED_J = 9
    SERVO_J = 11
    SPEED_STOP = 15
    SERVO_STOP = 16
    TEACH_ON = 18
    TEACH_OFF = 19
    SERVO_L = 24
    STEP_TIME = 26
    INVERSE_KINEMATICS_NEAR = 30
    TRIGGER_PROTECTIVE_STOP = 31
    STOP_L = 33
    STOP_J = 34
    WATCHDOG = 35
    FORWARD_KINEMATICS = 43
    FORWARD_KINEMATICS_OF = 44
    INVERSE_KINEMATICS = 46
    STEADY = 47
    FREEDRIVE_ON = 52
    FREEDRIVE_OFF = 53
    FREEDRIVE_STATUS = 54
    REACHES = 60
    REACHES_NEAR = 61
    END = 255


class Series(NamedTuple):
    """Data common to the controllers of one series."""

    version: tuple[int, int, int, int]
    """Version of their software."""
    rate_hz: float
    """Cycles a second."""
    lacks: frozenset[str]
    """Fields and lines that only the other series supports."""


E_SERIES: Final = Series((5, 11, 1, 108_318), 500.0, frozenset())
CB3: Final = Series((3, 15, 8, 106_339), 125.0, frozenset({"ft_raw_wrench", "is in remote control"}))


class Model:
    """The shape of an arm by Denavit-Hartenberg, in m."""

    def __init__(self, d1: float, a2: float, a3: float, d4: float, d5: float, d6: float) -> None:
        self.a = (0.0, a2, a3, 0.0, 0.0, 0.0)
        self.d = (d1, 0.0, 0.0, d4, d5, d6)


MODELS: Final = {
    "UR3": Model(0.1519, -0.24365, -0.21325, 0.11235, 0.08535, 0.0819),
    "UR3e": Model(0.15185, -0.24355, -0.2132, 0.13105, 0.08535, 0.0921),
    "UR5": Model(0.089159, -0.425, -0.39225, 0.10915, 0.09465, 0.0823),
    "UR5e": Model(0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996),
    "UR10": Model(0.1273, -0.612, -0.5723, 0.163941, 0.1157, 0.0922),
    "UR10e": Model(0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655),
    "UR16e": Model(0.1807, -0.4784, -0.36, 0.17415, 0.11985, 0.11655),
}
"""Universal Robots, "DH Parameters for calculations of kinematics and dynamics"."""
