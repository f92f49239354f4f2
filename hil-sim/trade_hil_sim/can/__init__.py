"""A simulated CAN bus: a wire with arbitration and bit rate, and an adapter for several clients of socketcand."""

from ._bus import CanBus
from ._device import Device, JointDevice
from ._frame import Frame
from ._joint_bus import JointBus
from ._text import Reader, error_text, frame_text, parse_send
from ._wire import Referee, Station, Wire

__all__ = [
    "CanBus",
    "Device",
    "Frame",
    "JointBus",
    "JointDevice",
    "Reader",
    "Referee",
    "Station",
    "Wire",
    "error_text",
    "frame_text",
    "parse_send",
]
