"""Simulated Dynamixel servos on Protocol 2.0: the bytes of the X series, without the hardware."""

from ._bus import DynamixelBus
from ._memory import HardwareError
from ._models import MODELS, XL430_W250, XM430_W350
from ._protocol import ErrorCode, Instruction, Packet, PacketReader, crc16, encode, status
from ._servo import Servo
from ._table import Access, Model, Register

__all__ = [
    "MODELS",
    "XL430_W250",
    "XM430_W350",
    "Access",
    "DynamixelBus",
    "ErrorCode",
    "HardwareError",
    "Instruction",
    "Model",
    "Packet",
    "PacketReader",
    "Register",
    "Servo",
    "crc16",
    "encode",
    "status",
]
