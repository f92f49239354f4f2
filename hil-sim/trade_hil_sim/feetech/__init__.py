"""Simulated Feetech STS servos: their bytes, without the hardware. All models move as an STS3215 does."""

from ._bus import FeetechBus
from ._protocol import Instruction, Packet, PacketReader, checksum, encode, status
from ._servo import Servo, Status
from ._table import MODELS, STS3215, Model, Register

__all__ = [
    "MODELS",
    "STS3215",
    "FeetechBus",
    "Instruction",
    "Model",
    "Packet",
    "PacketReader",
    "Register",
    "Servo",
    "Status",
    "checksum",
    "encode",
    "status",
]
