"""A Universal Robots arm and its controller: RTDE, dashboard and script port, with the motion of six joints."""

from ._arm import HOME, JOINTS, Arm
from ._bus import UrBus
from ._protocol import Packet, PacketType, Recipe
from ._table import INPUTS, MODELS, OUTPUTS, Command, RobotMode, SafetyMode
from ._tcp import PORTS

__all__ = [
    "HOME",
    "INPUTS",
    "JOINTS",
    "MODELS",
    "OUTPUTS",
    "PORTS",
    "Arm",
    "Command",
    "Packet",
    "PacketType",
    "Recipe",
    "RobotMode",
    "SafetyMode",
    "UrBus",
]
