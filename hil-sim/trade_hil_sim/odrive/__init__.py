"""Simulated ODrives on a CAN bus: CANSimple of firmware 0.6, written by hand from its documentation."""

from ._axis import Axis
from ._bus import OdriveBus
from ._table import Command, Control, Errors, Input, Result, State

__all__ = ["Axis", "Command", "Control", "Errors", "Input", "OdriveBus", "Result", "State"]
