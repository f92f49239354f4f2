"""Simulated Feetech STS servos: the bytes of the STS3215, without the hardware."""

from ._bus import FeetechBus
from ._protocol import Instruction, Packet, PacketReader, checksum, encode, status
from ._servo import Servo, Status
from ._table import STS3215, Model, Register

__all__ = [
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
