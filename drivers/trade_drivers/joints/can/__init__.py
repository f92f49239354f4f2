"""The common base of drivers for motors with their own controllers on a CAN bus, polled in each cycle."""

from trade_drivers.joints.can._axis import STILL_RAD_S, DifferentMotor, MotorAxis, check_keys, resolution_of
from trade_drivers.joints.can._driver import CanMotorCommissioner, CanMotorDriver, check_load

__all__ = [
    "STILL_RAD_S",
    "CanMotorCommissioner",
    "CanMotorDriver",
    "DifferentMotor",
    "MotorAxis",
    "check_keys",
    "check_load",
    "resolution_of",
]
