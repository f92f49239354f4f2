"""Simulated Damiao motors on a CAN bus, written by hand from the vendor's manuals."""

from ._bus import DamiaoBus
from ._codec import decode_mit, encode_feedback
from ._motor import Motor
from ._names import damiao_label
from ._table import MODELS, Mode, Ranges, Register, Status

__all__ = [
    "MODELS",
    "DamiaoBus",
    "Mode",
    "Motor",
    "Ranges",
    "Register",
    "Status",
    "damiao_label",
    "decode_mit",
    "encode_feedback",
]
