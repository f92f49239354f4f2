"""Simulated Damiao motors on a CAN bus, written by hand from the vendor's manuals."""

from ._bus import DamiaoBus
from ._motor import Motor
from ._protocol import decode_mit, encode_feedback
from ._table import MODELS, Mode, Ranges, Register, Status

__all__ = [
    "MODELS",
    "DamiaoBus",
    "Mode",
    "Motor",
    "Ranges",
    "Register",
    "Status",
    "decode_mit",
    "encode_feedback",
]
