"""Simulated Robotiq 2F-85 grippers: a Modbus RTU slave by hand, fingers, and an object between them."""

from ._bus import RobotiqBus
from ._gripper import Gripper, Object
from ._protocol import ExceptionCode, Function, Request, RequestReader, crc16, frame

__all__ = [
    "ExceptionCode",
    "Function",
    "Gripper",
    "Object",
    "Request",
    "RequestReader",
    "RobotiqBus",
    "crc16",
    "frame",
]
