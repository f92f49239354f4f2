"""The robot file: a robot's devices, their buses and their limits, as checked records.

The drivers, the simulators and tools read it. It needs nothing of the middleware.
"""

from trade_robotfile._convert import RobotFileError
from trade_robotfile._parse import load, parse
from trade_robotfile._records import (
    Arm,
    Bus,
    Camera,
    CanBus,
    Coupled,
    Drill,
    Gripper,
    Group,
    Joint,
    Robot,
    Sensor,
    SerialBus,
    UrBus,
)
from trade_robotfile._subset import without

__all__ = [
    "Arm",
    "Bus",
    "Camera",
    "CanBus",
    "Coupled",
    "Drill",
    "Gripper",
    "Group",
    "Joint",
    "Robot",
    "RobotFileError",
    "Sensor",
    "SerialBus",
    "UrBus",
    "load",
    "parse",
    "without",
]
